"""VisDrone2018-SOT-test-dev (Wen et al., ECCVW 2018): frames and labels in two trees."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.datasets.boxes import find_files
from psiamfcpp.datasets.sequence import LeftOut, Sequence, labelled_by

LAYOUT = "<root>/sequences/<sequence>/img0000001.jpg and <root>/annotations/<sequence>.txt (x,y,w,h per frame)"


def label_files(root: Path) -> dict[str, Path]:
    """The label file of each sequence, by name."""
    return {path.stem: path for path in find_files(root / "annotations", "*.txt")}


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Every sequence, by name.

    Raises:
        UserError: a file is missing or unreadable, or the frames and boxes differ in number.
    """
    return labelled_by(label_files(root), lambda name, _: root / "sequences" / name, LAYOUT, "visdrone2018", left_out)
