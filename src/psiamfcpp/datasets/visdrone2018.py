"""VisDrone2018-SOT-test-dev (Wen et al., ECCVW 2018): frames and labels in two trees."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.datasets.boxes import find_files, read_boxes
from psiamfcpp.datasets.sequence import LeftOut, Sequence, each, labelled, require
from psiamfcpp.images import image_files

LAYOUT = "<root>/sequences/<sequence>/img0000001.jpg and <root>/annotations/<sequence>.txt (x,y,w,h per frame)"


def label_files(root: Path) -> dict[str, Path]:
    """The label file of each sequence, by name."""
    return {path.stem: path for path in find_files(root / "annotations", "*.txt")}


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Every sequence, by name.

    Raises:
        UserError: a file is missing or unreadable, or the frames and boxes differ in number.
    """

    def one(item: tuple[str, Path]) -> Sequence:
        name, truth = item
        frames = require(root / "sequences" / name, LAYOUT)
        return labelled(name, image_files(frames.iterdir()), read_boxes(truth), "visdrone2018")

    return each(label_files(root).items(), one, left_out)
