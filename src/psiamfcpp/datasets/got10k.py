"""GOT-10k: ``<root>/{train,val}/GOT-10k_*/``, each with its frames and its labels side by side.

The boxes are taken as published, without a shift: the layout does not say where pixels start to count.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.datasets.boxes import read_boxes
from psiamfcpp.datasets.sequence import LeftOut, Sequence, each, matched, require
from psiamfcpp.errors import UserError, brief
from psiamfcpp.files import read_text
from psiamfcpp.images import image_files

LAYOUT = (
    "<root>/{train,val}/list.txt and <root>/{train,val}/GOT-10k_*/"
    "{00000001.jpg, groundtruth.txt, absence.label, cover.label}, or one of the two folders as <root>"
)


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Every sequence that ``list.txt`` names, in its order; no box where the target is absent or covered.

    Args:
        root: the folder that holds ``train`` and ``val`` (both are read), or one of these two.
        left_out: as of `psiamfcpp.datasets.read`.

    Raises:
        UserError: a file is missing or unreadable, or a sequence has another number of frames than of labels.
    """
    one_split = (root / "list.txt").exists()
    splits = [root] if one_split else [root / name for name in ("train", "val") if (root / name).is_dir()]
    folders = [
        s / name for s in splits for name in read_text(require(s / "list.txt", LAYOUT), "list of sequences").split()
    ]
    if not folders:
        raise UserError(f"{root} holds no sequence; expected layout: {LAYOUT}")
    return each(folders, lambda folder: _sequence(folder, left_out), left_out)


def read_labels(path: Path) -> NDArray[np.int64]:
    """The whole numbers of a label file, one per frame, separated by commas, blanks or line ends.

    Raises:
        UserError: the file cannot be read or holds something else.
    """
    words = read_text(path, "labels", "one integer a frame is expected").replace(",", " ").split()
    try:
        return np.array([int(word) for word in words], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise UserError(f"labels {path} cannot be read ({brief(error)}): one integer a frame is expected") from None


def _sequence(folder: Path, left_out: LeftOut) -> Sequence:
    boxes = read_boxes(require(folder / "groundtruth.txt", LAYOUT))
    absence = read_labels(require(folder / "absence.label", LAYOUT))
    cover = read_labels(require(folder / "cover.label", LAYOUT))
    frames = image_files(folder.iterdir())
    rows = {"boxes": len(boxes), "absence rows": len(absence), "cover rows": len(cover)}
    count = matched(str(folder), frames, rows, left_out)
    boxes, absence, cover = boxes[:count], absence[:count], cover[:count]
    # The cover label grades the visible part from 0 to 8: at 0 the box is a guess at an unseen target.
    boxes[(absence == 1) | (cover == 0) | ~(boxes[:, 2:] > 0).all(axis=1)] = np.nan
    return Sequence(folder.name, frames[:count], boxes, "got10k")
