"""LaSOT: ``<root>/<class>/<class>-N/``, or the same without the class folders.

The boxes are taken as published, without a shift. Training and test sequences share one tree, all are read:
to test on LaSOT later, keep the test sequences' folders elsewhere.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from psiamfcpp.datasets.boxes import find_files, read_boxes
from psiamfcpp.datasets.got10k import read_labels
from psiamfcpp.datasets.sequence import LeftOut, Sequence, each, matched, require
from psiamfcpp.errors import UserError
from psiamfcpp.images import image_files

LAYOUT = (
    "<root>/<class>/<class>-N/{img/00000001.jpg, groundtruth.txt, full_occlusion.txt, out_of_view.txt}, "
    "with or without the <class> folders"
)


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Every sequence, by class and number; no box where the target is fully occluded or out of view.

    Raises:
        UserError: there is none, a file is missing or unreadable, or the frames and labels differ in number.
    """
    named = [(_class_and_number(p.name), p) for p in (*find_files(root, "*-*"), *find_files(root, "*/*-*"))]
    found = sorted((key, path) for key, path in named if key is not None)
    if not found:
        raise UserError(f"{root} holds no sequence; expected layout: {LAYOUT}")
    return each(found, lambda item: _sequence(item[1], item[0][0], left_out), left_out)


def _class_and_number(name: str) -> tuple[str, int] | None:
    match = re.fullmatch(r"(.+)-(\d+)", name)
    return (match[1], int(match[2])) if match else None


def _sequence(folder: Path, source: str, left_out: LeftOut) -> Sequence:
    boxes = read_boxes(require(folder / "groundtruth.txt", LAYOUT))
    occluded = read_labels(require(folder / "full_occlusion.txt", LAYOUT))
    outside = read_labels(require(folder / "out_of_view.txt", LAYOUT))
    frames = image_files(require(folder / "img", LAYOUT).iterdir())
    rows = {"boxes": len(boxes), "occlusion flags": len(occluded), "view flags": len(outside)}
    count = matched(str(folder), frames, rows, left_out)
    boxes, occluded, outside = boxes[:count], occluded[:count], outside[:count]
    boxes[(occluded == 1) | (outside == 1) | ~(boxes[:, 2:] > 0).all(axis=1)] = np.nan
    return Sequence(folder.name, frames[:count], boxes, source)
