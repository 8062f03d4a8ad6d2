"""TrackingNet: ``<root>/TRAIN_0 .. TRAIN_11``, each with ``anno/<name>.txt`` and ``frames/<name>/N.jpg``.

The boxes are taken as published, without a shift.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from psiamfcpp.datasets.boxes import find_files, read_boxes
from psiamfcpp.datasets.sequence import LeftOut, Sequence, each, matched, require
from psiamfcpp.errors import UserError
from psiamfcpp.images import image_files

LAYOUT = (
    "<root>/TRAIN_<n>/anno/<name>.txt (x,y,w,h per frame) and <root>/TRAIN_<n>/frames/<name>/{0,1,...}.jpg, "
    "or one TRAIN_<n> folder as <root>"
)


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Every sequence of every chunk, by name within its chunk.

    Args:
        root: the folder that holds the chunks, all or some of them, or one chunk.
        left_out: as of `psiamfcpp.datasets.read`.

    Raises:
        UserError: there is none, a file is missing or unreadable, or the frames and boxes differ in number.
    """
    chunks = [root] if (root / "anno").is_dir() else sorted(p for p in root.glob("TRAIN_*") if p.is_dir())
    truths = [truth for chunk in chunks for truth in find_files(require(chunk / "anno", LAYOUT), "*.txt")]
    if not truths:
        raise UserError(f"{root} holds no sequence; expected layout: {LAYOUT}")
    return each(truths, lambda truth: _sequence(truth, left_out), left_out)


def _sequence(truth: Path, left_out: LeftOut) -> Sequence:
    boxes = read_boxes(truth)
    folder = require(truth.parent.parent / "frames" / truth.stem, LAYOUT)
    frames = sorted(image_files(folder.iterdir()), key=_number)
    count = matched(str(folder), frames, {"boxes": len(boxes)}, left_out)
    boxes = boxes[:count]
    boxes[~(boxes[:, 2:] > 0).all(axis=1)] = np.nan
    return Sequence(truth.stem, frames[:count], boxes, "trackingnet")


def _number(frame: Path) -> int:
    # The names are not padded with zeros, so that their alphabetical order is not the order in time.
    if not frame.stem.isdecimal():
        raise UserError(f"frame {frame} has no number for a name; expected layout: {LAYOUT}")
    return int(frame.stem)
