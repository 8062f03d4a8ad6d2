"""VisDrone2018-SOT-test-dev (Wen et al., ECCVW 2018): frames and labels in two trees."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.datasets.boxes import find_files, read_boxes
from psiamfcpp.datasets.sequence import Sequence, labelled, require
from psiamfcpp.images import image_files

LAYOUT = "<root>/sequences/<sequence>/img0000001.jpg and <root>/annotations/<sequence>.txt (x,y,w,h per frame)"


def label_files(root: Path) -> dict[str, Path]:
    """The label file of each sequence, by name."""
    return {path.stem: path for path in find_files(root / "annotations", "*.txt")}


def read(root: Path) -> list[Sequence]:
    """Every sequence, by name.

    Raises:
        UserError: a file is missing or unreadable, or the frames and boxes differ in number.
    """
    return [
        labelled(
            name, image_files(require(root / "sequences" / name, LAYOUT).iterdir()), read_boxes(truth), "visdrone2018"
        )
        for name, truth in label_files(root).items()
    ]
