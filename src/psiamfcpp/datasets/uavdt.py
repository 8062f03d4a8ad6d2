"""UAVDT, its single-object part (Du et al., ECCV 2018): frames and labels in two trees."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.datasets.boxes import find_files
from psiamfcpp.datasets.sequence import LeftOut, Sequence, labelled_by

LAYOUT = "<root>/sequences/<sequence>/img000001.jpg and <root>/anno/<sequence>_gt.txt (x,y,w,h per frame)"


def label_files(root: Path) -> dict[str, Path]:
    """The label file of each sequence, by name; ``root`` may also be the folder ``anno`` itself."""
    # Files of attributes, which lie beside the labels, end in _att.txt.
    folder = root / "anno" if (root / "anno").is_dir() else root
    return {path.name.removesuffix("_gt.txt"): path for path in find_files(folder, "*_gt.txt")}


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Every sequence, by name.

    Raises:
        UserError: a file is missing or unreadable, or the frames and boxes differ in number.
    """
    return labelled_by(label_files(root), lambda name, _: root / "sequences" / name, LAYOUT, "uavdt", left_out)
