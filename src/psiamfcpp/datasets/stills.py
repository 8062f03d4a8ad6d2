"""Labelled photographs: ``<root>/images/*`` and ``<root>/boxes.csv`` (image,x,y,w,h,label,source)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from psiamfcpp.datasets.sequence import LeftOut, Present, Sequence, require, tolerated
from psiamfcpp.errors import UserError, brief
from psiamfcpp.files import read_table

LAYOUT = "<root>/images/* and <root>/boxes.csv with the columns image,x,y,w,h,label,source"


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """One single-frame sequence an object.

    Raises:
        UserError: ``boxes.csv`` is missing, lacks a column, or holds something that is not a number; an image is
            missing.
    """
    table = require(root / "boxes.csv", LAYOUT)
    present = Present(root / "images")
    objects = []
    for line, row in read_table(table, "table", f"expected {LAYOUT}"):
        with tolerated(left_out):
            try:
                box = np.array([[float(row[key]) for key in "xywh"]])
                image, source = row["image"], row["source"]
            except (KeyError, ValueError) as error:
                problem = f"{table} line {line} is not a labelled box ({brief(error)})"
                raise UserError(f"{problem}; expected {LAYOUT}") from None
            objects.append(Sequence(f"{image}#{line}", [present.find(image, f"{table} line {line}")], box, source))
    return objects
