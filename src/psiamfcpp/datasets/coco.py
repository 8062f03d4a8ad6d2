"""COCO 2017: ``<root>/annotations/instances_{train,val}2017.json``, images in ``<root>/{train,val}2017/``."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from psiamfcpp.datasets.sequence import Sequence, require
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import FloatArray

LAYOUT = "<root>/annotations/instances_{train,val}2017.json and the images in <root>/{train,val}2017/"


def read(root: Path) -> list[Sequence]:
    """One single-frame sequence an annotated object, from whichever of the two parts is there.

    The source is the object's category. Crowds and empty boxes are left out: neither shows one target.

    Raises:
        UserError: there is no annotation file, one cannot be read, or an image is missing.
    """
    parts = {name: root / "annotations" / f"instances_{name}.json" for name in ("train2017", "val2017")}
    found = {name: table for name, table in parts.items() if table.exists()}
    if not found:
        raise UserError(f"{root} holds no annotation file; expected layout: {LAYOUT}")
    return [s for name, table in found.items() for s in _part(table, require(root / name, LAYOUT))]


def _part(table: Path, folder: Path) -> Iterator[Sequence]:
    try:
        content = json.loads(table.read_bytes())
        images = {image["id"]: folder / image["file_name"] for image in content["images"]}
        sources = {category["id"]: category["name"] for category in content["categories"]}
        labels = [
            (a["id"], images[a["image_id"]], _row(a["bbox"]), sources[a["category_id"]])
            for a in content["annotations"]
            if not a.get("iscrowd")
        ]
    except (AttributeError, KeyError, OSError, TypeError, ValueError) as error:
        problem = f"{type(error).__name__}: {error}"
        raise UserError(f"annotations {table} are not COCO instances ({problem}): fetch them again") from None
    present = set(folder.iterdir())
    for number, image, box, source in labels:
        if image not in present:
            raise UserError(f"{image} is missing; expected layout: {LAYOUT}")
        if (box[0, 2:] > 0).all():
            yield Sequence(f"{folder.name}/{image.stem}#{number}", [image], box, source)


def _row(box: list[float]) -> FloatArray:
    return np.array(box, dtype=np.float64).reshape(1, 4)
