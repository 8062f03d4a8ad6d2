"""DTB70 (Li and Yeung, AAAI 2017): one folder per sequence."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.datasets.boxes import find_files
from psiamfcpp.datasets.sequence import LeftOut, Sequence, labelled_by

LAYOUT = "<root>/<sequence>/img/*.jpg and <root>/<sequence>/groundtruth_rect.txt (x,y,w,h per frame)"


def label_files(root: Path) -> dict[str, Path]:
    """The label file of each sequence, by name."""
    return {path.parent.name: path for path in find_files(root, "*/groundtruth_rect.txt")}


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Every sequence, by name; zero rows, of targets out of view, stay as they are.

    Raises:
        UserError: a file is missing or unreadable, or the frames and boxes differ in number.
    """
    return labelled_by(label_files(root), lambda _, truth: truth.parent / "img", LAYOUT, "dtb70", left_out)
