"""Labelled photographs: ``<root>/images/*`` and ``<root>/boxes.csv`` (image,x,y,w,h,label,source)."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from psiamfcpp.datasets.sequence import Sequence, require
from psiamfcpp.errors import UserError

LAYOUT = "<root>/images/* and <root>/boxes.csv with the columns image,x,y,w,h,label,source"


def read(root: Path) -> list[Sequence]:
    """One single-frame sequence an object.

    Raises:
        UserError: ``boxes.csv`` is missing, lacks a column, or holds something that is not a number.
    """
    table = require(root / "boxes.csv", LAYOUT)
    objects = []
    with table.open(newline="") as file:
        for line, row in enumerate(csv.DictReader(file), start=2):
            try:
                box = np.array([[float(row[key]) for key in "xywh"]])
                image, source = row["image"], row["source"]
            except (KeyError, TypeError, ValueError) as error:
                problem = f"{table} line {line} is not a labelled box ({error})"
                raise UserError(f"{problem}; expected {LAYOUT}") from None
            objects.append(Sequence(f"{image}#{line}", [root / "images" / image], box, source))
    return objects
