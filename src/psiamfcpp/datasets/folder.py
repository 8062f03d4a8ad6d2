"""A plain folder of sequences, at any depth: ``<root>/.../<name>/{img/* or video.mp4, groundtruth_rect.txt}``."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from psiamfcpp.datasets.frames import video_frames
from psiamfcpp.datasets.sequence import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import FloatArray
from psiamfcpp.images import image_files

LAYOUT = (
    "<root>/.../<sequence>/img/*.jpg, or video.mp4 in its place, and <root>/.../<sequence>/groundtruth_rect.txt "
    "(x,y,w,h a frame)"
)

# What C libraries write for a number that is none, where Python's own spellings end: -nan(ind), 1.#QNAN, -1.#IND0.
_NAN = re.compile(r"[+-]?(nan\(\w*\)|1\.#(qnan|snan|ind|nan)\d*)", re.IGNORECASE)


def label_files(root: Path) -> dict[str, Path]:
    """The label file of each sequence, by name.

    Raises:
        UserError: two sequences have one name.
    """
    files: dict[str, Path] = {}
    for path in sorted(root.glob("**/groundtruth_rect.txt")):
        other = files.setdefault(path.parent.name, path)
        if other != path:
            raise UserError(f"{other.parent} and {path.parent} have one name: rename one of the two sequences")
    return files


def read(root: Path) -> list[Sequence]:
    """Every sequence under ``root``, by name; the source is the name up to its first ``_`` or digit.

    Raises:
        UserError: there is none, or one has another number of frames than of boxes.
    """
    truths = sorted(root.glob("**/groundtruth_rect.txt"))
    if not truths:
        raise UserError(
            f"{root} holds no sequence: {root}/.../groundtruth_rect.txt is missing; expected layout: {LAYOUT}"
        )
    return [_sequence(truth.parent) for truth in truths]


def read_boxes(path: Path) -> FloatArray:
    """Boxes ``(n, 4)`` from a text file with one box a line, separated by commas, tabs or blanks; NaN in any spelling.

    Raises:
        UserError: the file is missing or holds anything but four numbers a line; names the line.
    """
    try:
        lines = path.read_text("utf-8-sig").rstrip().splitlines()
    except (OSError, ValueError) as error:
        raise UserError(f"boxes {path} cannot be read ({error}): one x,y,w,h a line is expected") from None
    boxes = np.empty((len(lines), 4))
    for row, line in enumerate(lines):
        try:
            x, y, w, h = line.replace(",", " ").split()
            boxes[row] = _number(x), _number(y), _number(w), _number(h)
        except ValueError:
            problem = f"boxes {path} cannot be read: line {row + 1} is {line[:60]!r}"
            raise UserError(f"{problem}, but x,y,w,h is expected; was the file cut? fetch it again") from None
    return boxes


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        if _NAN.fullmatch(word):
            return math.nan
        raise


def source_of(name: str) -> str:
    """The collection that a clip's name begins with: what stands before its first ``_`` or digit."""
    return re.split(r"[_\d]", name, maxsplit=1)[0]


def _sequence(folder: Path) -> Sequence:
    boxes, video = read_boxes(folder / "groundtruth_rect.txt"), folder / "video.mp4"
    images = image_files((folder / "img").glob("*"))
    # The frames as they were taken, where both are there.
    frames = images if images or not video.exists() else video_frames(video)
    if len(frames) != len(boxes):
        raise UserError(f"sequence {folder} has {len(frames)} images but {len(boxes)} boxes: correct the folder")
    return Sequence(folder.name, frames, boxes, source_of(folder.name))
