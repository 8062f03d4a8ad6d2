"""Boxes on their way to disk, line by line: text for benchmarks, CSV and JSON lines for everything else."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from psiamfcpp.video.drawing import Shown
from psiamfcpp.video.writer import LineWriter

COLUMNS = ("seconds", "frame", "target", "x", "y", "w", "h", "score", "state")
"""of a CSV file; ``frame`` counts from 0, ``target`` from 1, boxes are pixels"""


def csv_row(seconds: float, frame: int, target: int, track: Shown) -> str:
    """Return a line of a CSV file with `COLUMNS`; what the tracker does not say is empty."""
    score = "" if track.score is None else f"{track.score:.3f}"
    return f"{seconds:.3f},{frame},{target},{_text(track)},{score},{track.state or ''}"


def _json_row(seconds: float, frame: int, target: int, track: Shown) -> str:
    box = [round(v, 2) for v in track.box]
    score = None if track.score is None else round(track.score, 3)
    row = {"seconds": round(seconds, 3), "frame": frame, "target": target, "box": box}
    return json.dumps({**row, "score": score, "state": track.state})


def _text(track: Shown) -> str:
    return ",".join(f"{v:.2f}" for v in track.box)


# of the formats that hold all targets in one file
_ROWS: dict[str, Callable[[float, int, int, Shown], str]] = {".csv": csv_row, ".jsonl": _json_row}


def boxes_paths(path: Path, count: int) -> list[Path]:
    """Return the files that hold the boxes of a number of targets.

    A ``.csv`` or ``.jsonl`` file holds them all. Any other is text for one target: the path itself for one,
    ``boxes.1.txt``, ``boxes.2.txt``... for several.
    """
    if count == 1 or path.suffix.lower() in _ROWS:
        return [path]
    return [path.with_name(f"{path.stem}.{number}{path.suffix}") for number in range(1, count + 1)]


class BoxWriter:
    """Files of boxes that are on disk line by line, and never hold half a line.

    ``.csv`` and ``.jsonl``: one line per target and frame, with time, score and state. Any other name: one
    ``x,y,w,h`` per line and frame, as benchmarks read it, with a file for each target.
    """

    def __init__(self, path: str | Path, targets: int = 1, fps: float = 30.0) -> None:
        """Start the files anew.

        Args:
            path: the file, see `boxes_paths` for several targets.
            targets: number of targets.
            fps: frames per second of the source, for the column of seconds.

        Raises:
            UserError: a file cannot be created.
        """
        path = Path(path)
        self._row, self._fps = _ROWS.get(path.suffix.lower()), fps
        with contextlib.ExitStack() as stack:
            self._files = [stack.enter_context(LineWriter(each, "boxes")) for each in boxes_paths(path, targets)]
            if self._row is csv_row:
                self._files[0].write(",".join(COLUMNS))
            self._stack = stack.pop_all()

    def __enter__(self) -> BoxWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, frame: int, tracks: Sequence[Shown]) -> None:
        """Append the boxes of a frame.

        Args:
            frame: its number in the source, from 0.
            tracks: one per target, in the order of the targets.

        Raises:
            UserError: the disk is full; the lines before stay.
        """
        if self._row is None:
            for file, track in zip(self._files, tracks, strict=True):
                file.write(_text(track))
        else:
            row, seconds = self._row, frame / self._fps
            self._files[0].write(*(row(seconds, frame, target, track) for target, track in enumerate(tracks, start=1)))

    def close(self) -> None:
        """Close the files; may be called twice."""
        self._stack.close()
