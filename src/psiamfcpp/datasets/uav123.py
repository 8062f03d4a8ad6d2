"""UAV123, UAV20L and UAV123@10fps (Mueller et al., ECCV 2016): long videos, cut into sequences by frame ranges.

`car1_1` and `car1_2` are parts of the folder `car1`. Which frames a sequence has stands in ``configSeqs.m`` of the
authors' MATLAB toolkit. Where that is not at hand, the ranges at 10 frames a second, which are shipped here, give those
of UAV123 too, since they are of every third frame; the sequences of UAV20L are whole videos.
"""

from __future__ import annotations

import csv
import functools
import re
from dataclasses import dataclass
from pathlib import Path

from psiamfcpp.datasets.boxes import find_files, read_boxes
from psiamfcpp.datasets.sequence import LeftOut, Sequence, each, labelled, require
from psiamfcpp.errors import UserError
from psiamfcpp.files import read_bytes

_RANGES_10FPS = Path(__file__).parent / "tables" / "uav123_10fps_ranges.csv"
# One sequence in configSeqs.m; its path may be joined from a variable and a quoted end.
_STRUCT = re.compile(
    r"struct\(\s*'name'\s*,\s*'(?P<name>[^']+)'\s*,\s*'path'\s*,[^']*'(?P<path>[^']+)'[^']*,"
    r"\s*'startFrame'\s*,\s*(?P<first>\d+)\s*,\s*'endFrame'\s*,\s*(?P<last>\d+)"
)


@dataclass(frozen=True)
class _Range:
    folder: str
    first: int
    last: int


@dataclass(frozen=True)
class Uav123:
    """One of the three benchmarks, which share a layout."""

    name: str
    """name of the benchmark"""
    frames: str
    """its folder in ``data_seq``"""
    labels: str
    """its folder in ``anno``"""

    @property
    def layout(self) -> str:
        """The expected layout, in one line."""
        return f"<root>/data_seq/{self.frames}/<folder>/000001.jpg and <root>/anno/{self.labels}/<sequence>.txt"

    def label_files(self, root: Path) -> dict[str, Path]:
        """The label file of each sequence, by name."""
        return {path.stem: path for path in find_files(root / "anno" / self.labels, "*.txt")}

    def read(self, root: Path, left_out: LeftOut = None) -> list[Sequence]:
        """Every sequence, by name.

        Raises:
            UserError: a file is missing or unreadable, or a sequence's frames are not known.
        """
        files = self.label_files(root)
        folders = require(root / "data_seq" / self.frames, self.layout) if files else root
        ranges = self._ranges(root)
        # Parts of one video share its folder: list it once.
        present = functools.cache(lambda folder: {p.name for p in require(folder, self.layout).glob("[!.]*.jpg")})

        def one(item: tuple[str, Path]) -> Sequence:
            name, truth = item
            boxes = read_boxes(truth)
            own = len(present(folders / name)) if (folders / name).is_dir() else 0
            part = _choose(name, len(boxes), ranges.get(name, []), own)
            folder = folders / part.folder
            frames = [folder / f"{number:06d}.jpg" for number in range(part.first, part.last + 1)]
            lacking = next((frame for frame in frames if frame.name not in present(folder)), None)
            if lacking is not None:
                raise UserError(f"{lacking} is missing; expected layout: {self.layout}")
            return labelled(name, frames, boxes, self.name)

        return each(files.items(), one, left_out)

    def _ranges(self, root: Path) -> dict[str, list[_Range]]:
        """What the frames of each sequence may be."""
        if self.name == "uav123-10fps":
            return _shipped_ranges()
        return _published_ranges(root, self.frames) or (_ranges_at_30fps() if self.name == "uav123" else {})


UAV123 = Uav123("uav123", "UAV123", "UAV123")
UAV20L = Uav123("uav20l", "UAV123", "UAV20L")
UAV123_10FPS = Uav123("uav123-10fps", "UAV123_10fps", "UAV123_10fps")


def _choose(name: str, rows: int, ranges: list[_Range], own: int) -> _Range:
    """The range that holds as many frames as there are labels; ``own`` is how many a folder of the name itself has."""
    # configSeqs.m lists UAV123 and UAV20L, which share names and folders: the number of labels separates them.
    fitting = [part for part in ranges if part.last - part.first + 1 == rows]
    if fitting:
        return fitting[0]
    if own and (not ranges or own == rows):
        return _Range(name, 1, rows)
    if not ranges:
        raise UserError(f"which frames sequence {name} has is not known: put the toolkit's configSeqs.m into the root")
    lengths = " or ".join(str(part.last - part.first + 1) for part in ranges)
    raise UserError(
        f"sequence {name} has {rows} boxes, but its range of frames holds {lengths}: fetch the labels again"
    )


def _shipped_ranges() -> dict[str, list[_Range]]:
    with _RANGES_10FPS.open(newline="") as file:
        return {
            row["sequence"]: [_Range(row["folder"], int(row["first_frame"]), int(row["last_frame"]))]
            for row in csv.DictReader(file)
        }


def _ranges_at_30fps() -> dict[str, list[_Range]]:
    """Ranges of UAV123: frame k at 10 frames a second is its frame 3k - 2, and up to two follow the last."""
    return {
        name: [_Range(part.folder, 3 * part.first - 2, 3 * part.last - 2 + after) for after in range(3)]
        for name, (part,) in _shipped_ranges().items()
    }


def _published_ranges(root: Path, frames: str) -> dict[str, list[_Range]]:
    """What ``configSeqs.m`` in the root, or one folder below, says of a folder of ``data_seq``; empty without it."""
    ranges: dict[str, list[_Range]] = {}
    for path in sorted([*root.glob("configSeqs.m"), *root.glob("*/configSeqs.m")])[:1]:
        # The comments of MATLAB users are seldom UTF-8.
        for found in _STRUCT.finditer(read_bytes(path, "configuration", "fetch it again", 2**24).decode("latin-1")):
            *above, folder = re.split(r"[\\/]+", found["path"].strip("\\/"))
            if not above or above[-1] == frames:
                part = _Range(folder, int(found["first"]), int(found["last"]))
                ranges.setdefault(found["name"], []).append(part)
    return ranges
