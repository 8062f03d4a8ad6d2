"""Text files of boxes, one ``x,y,w,h`` per line: labels of benchmarks and results of trackers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.files import read_text, write_whole
from psiamfcpp.geometry import FloatArray

# How C libraries write NaN where Python's own spellings end: -nan(ind), 1.#QNAN, -1.#IND0.
_NAN = re.compile(r"[+-]?(nan\(\w*\)|1\.#(qnan|snan|ind|nan)\d*)", re.IGNORECASE)


def read_boxes(path: Path) -> FloatArray:
    """Read boxes ``(n, 4)``, one per line, separated by commas, tabs or blanks; NaN in any spelling.

    Raises:
        UserError: the file is missing or a line does not hold four numbers; names the line.
    """
    lines = read_text(path, "boxes", "one x,y,w,h per line is expected").rstrip().splitlines()
    boxes = np.empty((len(lines), 4))
    for row, line in enumerate(lines):
        words = line.replace(",", " ").split()
        try:
            x, y, w, h = words
            boxes[row] = _number(x), _number(y), _number(w), _number(h)
        except ValueError:
            problem = f"boxes {path} cannot be read: line {row + 1} is {line[:60]!r}, but four numbers are expected"
            cut = row == len(lines) - 1 and len(words) < 4
            raise UserError(problem + ("; was the file cut? fetch it again" if cut else ": x,y,w,h")) from None
    return boxes


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        if _NAN.fullmatch(word):
            return math.nan
        raise


def write_boxes(path: Path, boxes: Iterable[FloatArray], decimals: int = 4) -> None:
    """Write boxes ``(x, y, w, h)``, pixels, one per line; `read_boxes` reads them.

    Raises:
        UserError: the file cannot be written.
    """
    write_whole(path, "".join(",".join(f"{v:.{decimals}f}" for v in box) + "\n" for box in boxes))


def find_files(root: Path, pattern: str) -> list[Path]:
    """Return what matches a glob pattern below a folder, sorted; hidden names are passed over.

    Archives packed on a Mac hold a ``._name`` beside each file, and editors keep hidden folders of copies.
    """
    paths = root.glob(pattern)
    return sorted(p for p in paths if not any(part.startswith(".") for part in p.relative_to(root).parts))
