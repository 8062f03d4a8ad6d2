"""OTB100 (Wu et al., TPAMI 2015): one folder per sequence, some with two targets.

Two targets have ``groundtruth_rect.1.txt`` and ``.2.txt``; their sequences are called ``Jogging-1``, ``Jogging-2``.
"""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.datasets.boxes import find_files, read_boxes
from psiamfcpp.datasets.sequence import LeftOut, Sequence, each, require
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import FloatArray
from psiamfcpp.images import image_files

LAYOUT = "<root>/<sequence>/img/0001.jpg and <root>/<sequence>/groundtruth_rect.txt (or .1.txt and .2.txt)"

# The number of the first labelled frame where that is not 1. The number of rows says where the labels end:
# the folders of Diving, Football1, Freeman3 and Freeman4 hold more frames than that.
_FIRST_FRAME = {"BlurCar1": 247, "BlurCar3": 3, "BlurCar4": 18, "David": 300, "Tiger1": 6}
# Rows of a label file, and how many of them at its beginning no toolkit counts.
_UNCOUNTED = {"Tiger1": (354, 5)}


def label_files(root: Path) -> dict[str, Path]:
    """The label file of each target, by the sequence's name, with ``-1`` or ``-2`` where a file is numbered."""
    files = {}
    for path in find_files(root, "*/groundtruth_rect*.txt"):
        number = path.stem.removeprefix("groundtruth_rect").lstrip(".")
        # The benchmark follows the second target of Human4 alone, whatever its first file holds.
        if (path.parent.name, number) != ("Human4", "1"):
            files[path.parent.name + (f"-{number}" if number else "")] = path
    return files


def counted(name: str, boxes: FloatArray) -> FloatArray:
    """The rows ``(m, 4)`` that count of labels, or of a result, of all frames ``(n, 4)``."""
    rows, before = _UNCOUNTED.get(name, (0, 0))
    return boxes[before:] if len(boxes) == rows else boxes


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Every target, by name, with the frames that its labels are of.

    Raises:
        UserError: a file is missing or unreadable.
    """
    return each(label_files(root).items(), lambda item: _sequence(*item), left_out)


def _sequence(name: str, truth: Path) -> Sequence:
    boxes, folder = counted(name, read_boxes(truth)), require(truth.parent / "img", LAYOUT)
    by_number = {int(path.stem): path for path in image_files(folder.iterdir()) if path.stem.isdecimal()}
    first = _FIRST_FRAME.get(truth.parent.name, 1)
    numbers = range(first, first + len(boxes))
    lacking = next((n for n in numbers if n not in by_number), None)
    if lacking is not None:
        problem = f"sequence {name} has {len(boxes)} boxes, from frame {first} on, but {folder} has no frame {lacking}"
        raise UserError(f"{problem}: fetch it again")
    return Sequence(name, [by_number[n] for n in numbers], boxes, "otb100")
