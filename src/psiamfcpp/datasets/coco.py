"""COCO 2017: ``<root>/annotations/instances_{train,val}2017.json``, images in ``<root>/{train,val}2017/``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from psiamfcpp.datasets.sequence import LeftOut, Present, Sequence, require, tolerated
from psiamfcpp.errors import UserError, brief
from psiamfcpp.files import read_json
from psiamfcpp.geometry import FloatArray

LAYOUT = "<root>/annotations/instances_{train,val}2017.json and the images in <root>/{train,val}2017/"


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """One single-frame sequence an annotated object, from whichever of the two parts is there.

    The source is the object's category. Crowds and objects without a box that has an area are left out, since neither
    shows one target; so are annotations of images that are not listed.

    Raises:
        UserError: there is no annotation file, one cannot be read, or an image is missing.
    """
    parts = {name: root / "annotations" / f"instances_{name}.json" for name in ("train2017", "val2017")}
    found = {name: table for name, table in parts.items() if table.exists()}
    if not found:
        raise UserError(f"{root} holds no annotation file; expected layout: {LAYOUT}")
    sequences = [s for name, table in found.items() for s in _part(table, require(root / name, LAYOUT), left_out)]
    if not sequences:
        raise UserError(f"annotations in {root} are of no object with a box and an image: fetch them again")
    return sequences


def _part(table: Path, folder: Path, left_out: LeftOut) -> Iterator[Sequence]:
    content = read_json(table, "annotations", "fetch them again")
    try:
        images = {image["id"]: Path(image["file_name"]) for image in content["images"]}
        sources = {category["id"]: str(category["name"]) for category in content["categories"]}
        labels = list(content["annotations"])
    except (KeyError, TypeError) as error:
        raise _foreign(table, error) from None
    present = Present(folder)
    for number, label in enumerate(labels):
        with tolerated(left_out):
            try:
                image, box = images.get(label["image_id"]), label.get("bbox")
                if image is None or not box or label.get("iscrowd"):
                    continue
                row, source = _row(box), sources[label["category_id"]]
                named = label.get("id", number)
            except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
                raise _foreign(table, error, label) from None
            if (row[0, 2:] > 0).all():
                path = present.find(image, str(table))
                yield Sequence(f"{folder.name}/{image.with_suffix('')}#{named}", [path], row, source)


def _foreign(table: Path, error: Exception, label: object = None) -> UserError:
    """What to say of annotations, or of one of them, that are not as COCO's."""
    which = "" if label is None else f"annotation {label.get('id') if isinstance(label, dict) else label!r}: "[:80]
    problem = f"{which}{type(error).__name__}: {brief(error)}"
    return UserError(f"annotations {table} are not COCO instances ({problem}): fetch them again")


def _row(box: Any) -> FloatArray:
    row = np.array(box, dtype=np.float64).reshape(1, 4)
    if not np.isfinite(row).all():
        raise ValueError(f"its bbox is {box}")
    return row
