"""GOT-10k: ``<root>/{train,val}/GOT-10k_*/``, each with its frames and its labels side by side.

The boxes are taken as published, without a shift: the layout does not say where pixels start to count.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.datasets.boxes import read_boxes
from psiamfcpp.datasets.sequence import Sequence, require
from psiamfcpp.errors import UserError
from psiamfcpp.images import image_files

LAYOUT = (
    "<root>/{train,val}/list.txt and <root>/{train,val}/GOT-10k_*/"
    "{00000001.jpg, groundtruth.txt, absence.label, cover.label}, or one of the two folders as <root>"
)


def read(root: Path) -> list[Sequence]:
    """Every sequence that ``list.txt`` names, in its order; no box where the target is absent or covered.

    Args:
        root: the folder that holds ``train`` and ``val`` (both are read), or one of these two.

    Raises:
        UserError: a file is missing or unreadable, or a sequence has another number of frames than of labels.
    """
    one_split = (root / "list.txt").exists()
    splits = [root] if one_split else [root / name for name in ("train", "val") if (root / name).is_dir()]
    folders = [s / name for s in splits for name in require(s / "list.txt", LAYOUT).read_text().split()]
    if not folders:
        raise UserError(f"{root} holds no sequence; expected layout: {LAYOUT}")
    return [_sequence(folder) for folder in folders]


def read_labels(path: Path) -> NDArray[np.int64]:
    """The whole numbers of a label file, one per frame, separated by commas, blanks or line ends.

    Raises:
        UserError: the file cannot be read or holds something else.
    """
    try:
        return np.array([int(v) for v in path.read_text("utf-8-sig").replace(",", " ").split()], dtype=np.int64)
    except (OSError, ValueError) as error:
        raise UserError(f"labels {path} cannot be read ({error}): one integer a frame is expected") from None


def _sequence(folder: Path) -> Sequence:
    boxes = read_boxes(require(folder / "groundtruth.txt", LAYOUT))
    absence = read_labels(require(folder / "absence.label", LAYOUT))
    cover = read_labels(require(folder / "cover.label", LAYOUT))
    frames = image_files(folder.iterdir())
    if not len(frames) == len(boxes) == len(absence) == len(cover):
        counts = f"{len(frames)} images, {len(boxes)} boxes, {len(absence)} absence, {len(cover)} cover rows"
        raise UserError(f"sequence {folder} has {counts}: the counts must be equal, fetch it again")
    # The cover label grades the visible part from 0 to 8: at 0 the box is a guess at an unseen target.
    boxes[(absence == 1) | (cover == 0) | ~(boxes[:, 2:] > 0).all(axis=1)] = np.nan
    return Sequence(folder.name, frames, boxes, "got10k")
