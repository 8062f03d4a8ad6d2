"""Video clips with several tracks each: ``<root>/*.mp4`` and ``<root>/boxes.csv`` (clip,frame,track,x,y,w,h)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from psiamfcpp.datasets.folder import source_of
from psiamfcpp.datasets.frames import VideoFrame, video_frames
from psiamfcpp.datasets.sequence import LeftOut, Sequence, each, require, tolerated
from psiamfcpp.errors import UserError, brief
from psiamfcpp.files import read_table
from psiamfcpp.geometry import FloatArray

LAYOUT = "<root>/<clip>.mp4 and <root>/boxes.csv with the columns clip,frame,track,x,y,w,h (frames count from 0)"


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Return one sequence per track, in the order of the table.

    The source of a sequence is the clip's name up to its first ``_`` or digit.
    A frame without a row has no box: the target is absent there, or not labelled.

    Raises:
        UserError: the table or a clip is missing, a line is not a box, or a clip ends before a labelled frame.
    """
    table = require(root / "boxes.csv", LAYOUT)
    tracks: dict[tuple[str, str], dict[int, list[float]]] = {}
    for line, row in read_table(table, "table", f"expected layout: {LAYOUT}"):
        with tolerated(left_out):
            try:
                number, box = int(row["frame"]), [float(row[key]) for key in "xywh"]
                tracks.setdefault((row["clip"], row["track"]), {})[number] = box
            except (KeyError, ValueError) as error:
                problem = f"{table} line {line} is not a labelled box ({brief(error)})"
                raise UserError(f"{problem}; expected layout: {LAYOUT}") from None
    frames = {}
    for clip in dict.fromkeys(clip for clip, _ in tracks):
        with tolerated(left_out):
            frames[clip] = video_frames(require(root / f"{clip}.mp4", LAYOUT))
    shown = [(clip, track, boxes) for (clip, track), boxes in tracks.items() if clip in frames]
    return each(shown, lambda item: _track(*item, frames[item[0]]), left_out)


def _track(clip: str, track: str, labelled: dict[int, list[float]], frames: list[VideoFrame]) -> Sequence:
    boxes: FloatArray = np.full((len(frames), 4), np.nan)
    for number, box in labelled.items():
        if not 0 <= number < len(frames):
            raise UserError(f"clip {clip} has {len(frames)} frames, but a box in frame {number}: fetch it again")
        boxes[number] = box
    return Sequence(f"{clip}_t{track}", frames, boxes, source_of(clip), clip)
