"""The validation split of GOT-10k (Huang et al., TPAMI 2019) as a benchmark: its labels stand as published."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.datasets.boxes import read_boxes
from psiamfcpp.datasets.sequence import LeftOut, Sequence, each, labelled, require
from psiamfcpp.files import read_text
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
    names = read_text(split / "list.txt", "list of sequences", f"expected layout: {LAYOUT}").split()
    return {name: split / name / "groundtruth.txt" for name in names}


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Every sequence that ``list.txt`` names, in its order.

    Raises:
        UserError: a file is missing or unreadable, or the frames and boxes differ in number.
    """

    def one(item: tuple[str, Path]) -> Sequence:
        name, truth = item
        boxes = read_boxes(require(truth, LAYOUT))
        return labelled(name, image_files(truth.parent.iterdir()), boxes, "got10k-val")

    return each(label_files(root).items(), one, left_out)
