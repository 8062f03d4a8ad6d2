"""DTB70 (Li and Yeung, AAAI 2017): one folder per sequence."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.datasets.boxes import find_files, read_boxes
from psiamfcpp.datasets.sequence import LeftOut, Sequence, each, labelled, require
from psiamfcpp.images import image_files

LAYOUT = "<root>/<sequence>/img/*.jpg and <root>/<sequence>/groundtruth_rect.txt (x,y,w,h per frame)"


def label_files(root: Path) -> dict[str, Path]:
    """The label file of each sequence, by name."""
    return {path.parent.name: path for path in find_files(root, "*/groundtruth_rect.txt")}


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Every sequence, by name; zero rows, of targets out of view, stay as they are.

    Raises:
        UserError: a file is missing or unreadable, or the frames and boxes differ in number.
    """

    def one(item: tuple[str, Path]) -> Sequence:
        name, truth = item
        return labelled(name, image_files(require(truth.parent / "img", LAYOUT).iterdir()), read_boxes(truth), "dtb70")

    return each(label_files(root).items(), one, left_out)
