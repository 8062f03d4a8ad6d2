"""The validation split of GOT-10k (Huang et al., TPAMI 2019) as a benchmark: its labels stand as published."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.datasets.boxes import read_boxes
from psiamfcpp.datasets.sequence import Sequence, labelled, require
from psiamfcpp.images import image_files

LAYOUT = "<root>/val/list.txt and <root>/val/GOT-10k_Val_*/{00000001.jpg, groundtruth.txt}, or the folder val as <root>"


def label_files(root: Path) -> dict[str, Path]:
    """The label file of each sequence that ``list.txt`` names, in its order.

    Raises:
        UserError: one is missing.
    """
    split = root / "val" if (root / "val").is_dir() else root
    if not (split / "list.txt").exists():
        return {}
    names = (split / "list.txt").read_text().split()
    return {name: require(split / name / "groundtruth.txt", LAYOUT) for name in names}


def read(root: Path) -> list[Sequence]:
    """Every sequence that ``list.txt`` names, in its order.

    Raises:
        UserError: a file is missing or unreadable, or the frames and boxes differ in number.
    """
    return [
        labelled(name, image_files(truth.parent.iterdir()), read_boxes(truth), "got10k-val")
        for name, truth in label_files(root).items()
    ]
