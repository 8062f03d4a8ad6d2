"""UAVDT, its single-object part (Du et al., ECCV 2018): frames and labels in two trees."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.datasets.boxes import find_files, read_boxes
from psiamfcpp.datasets.sequence import LeftOut, Sequence, each, labelled, require
from psiamfcpp.images import image_files

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

    def one(item: tuple[str, Path]) -> Sequence:
        name, truth = item
        frames = require(root / "sequences" / name, LAYOUT)
        return labelled(name, image_files(frames.iterdir()), read_boxes(truth), "uavdt")

    return each(label_files(root).items(), one, left_out)
