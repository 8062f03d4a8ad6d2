"""The loop behind `track` and `demo`: frames in, boxes, video and figures out."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image
from psiamfcpp.tracking import Track, Tracker
from psiamfcpp.video.drawing import STATE_COLOURS, draw, draw_status
from psiamfcpp.video.writer import BoxWriter, VideoWriter


@dataclass
class Followed:
    """What was found, frame by frame."""

    tracks: list[Track] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    """time of each init or update, apart from decoding and drawing"""
    ended: str = ""
    """why it ended early, if it did"""

    @property
    def fps(self) -> float:
        """Frames per second of the tracker: the median over its updates."""
        updates = self.seconds[1:]
        return float(1 / np.median(updates)) if updates else 0.0


def follow(
    frames: Iterator[Image],
    tracker: Tracker,
    box: Box,
    fps: float,
    output: Path | None = None,
    boxes: Path | None = None,
    advance: Callable[[], None] = lambda: None,
) -> Followed:
    """Follow a box through frames, writing as it goes.

    An interruption or a source that breaks off ends it; what was written until then is complete.

    Args:
        frames: ``(H, W, 3)`` uint8, BGR.
        tracker: the tracker to use.
        box: the target on the first frame.
        fps: frame rate of the written video.
        output: video to write, with box, score, state and speed.
        boxes: text file to write, ``x,y,w,h`` a line.
        advance: called after each frame.

    Raises:
        UserError: the first frame cannot be had, the box is wrong, or a file cannot be written.
    """
    result = Followed()
    with contextlib.ExitStack() as files:
        video: VideoWriter | None = None
        box_file: BoxWriter | None = None
        try:
            while (frame := _next(frames, result)) is not None:
                start = time.perf_counter()
                track = tracker.update(frame) if result.tracks else tracker.init(frame, box)
                result.seconds.append(time.perf_counter() - start)
                if not result.tracks:
                    # Not before a box was accepted: a wrong one must not cost the files of an earlier run.
                    if output:
                        video = files.enter_context(VideoWriter(output, fps, (frame.shape[1], frame.shape[0])))
                    if boxes:
                        box_file = files.enter_context(BoxWriter(boxes))
                result.tracks.append(track)
                if box_file:
                    box_file.write(track.box)
                if video:
                    video.write(annotate(frame, track, result.fps))
                advance()
        except KeyboardInterrupt:
            if not result.tracks:
                raise
            result.ended = "interrupted"
    return result


def annotate(frame: Image, track: Track, fps: float) -> Image:
    """A copy of the frame with box, score, state and speed."""
    label = f"{track.state} {track.score:.2f}"
    return draw_status(draw(frame, track.box, label, STATE_COLOURS[track.state]), [f"{fps:.0f} fps"])


def _next(frames: Iterator[Image], result: Followed) -> Image | None:
    """The next frame, or None at the end; once something was followed, a break is an end with its reason."""
    try:
        return next(frames, None)
    except UserError as error:
        if not result.tracks:
            raise
        result.ended = str(error)
        return None
