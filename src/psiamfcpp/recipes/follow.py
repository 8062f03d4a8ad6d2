"""Follow boxes through a source: `follow` for Python users, `follow_to_files` behind `track` and `demo`."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image
from psiamfcpp.trackers import TargetPool, Track, TrackerOptions
from psiamfcpp.video.boxes import BoxWriter
from psiamfcpp.video.capture import FALLBACK_FPS
from psiamfcpp.video.drawing import Overlay, draw_status, draw_targets
from psiamfcpp.video.source import open_source
from psiamfcpp.video.span import Shot, Span, shots
from psiamfcpp.video.threads import behind
from psiamfcpp.video.writer import VideoWriter
from psiamfcpp.zoo import DEFAULT_MODEL

_TRAIL_S = 2.0


@dataclass
class Followed:
    """What was found, frame by frame."""

    tracks: list[list[Track]] = field(default_factory=list)
    """frame by frame, in each the targets in the order of their boxes"""
    numbers: list[int] = field(default_factory=list)
    """of each frame in the source, from 0"""
    size: tuple[int, int] = (0, 0)
    """``(width, height)`` of the frames, pixels"""
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
    source: str | int | Path | Iterable[Image],
    boxes: Sequence[ArrayLike],
    tracker: str = DEFAULT_MODEL,
    options: TrackerOptions = TrackerOptions(),  # noqa: B008 - frozen
    span: Span = Span(),  # noqa: B008 - frozen
) -> Iterator[list[Track]]:
    """Follow boxes through a video, frame by frame.

    Args:
        source: a video file, camera number, address, folder or glob of images (see `psiamfcpp.video.source`), or the
            frames themselves, each ``(H, W, 3)`` uint8, BGR.
        boxes: ``(x, y, w, h)`` of each target on the first frame of the span, pixels, 0-based; at least one.
        tracker: our model, or any other tracker (see `psiamfcpp.open_tracker`).
        options: how our model runs.
        span: which part of the source to follow, as ``Span(start="1:30", stop="#4000", every=2)``.

    Yields:
        For each frame of the span one track per box, in the order of the boxes; the first frame's are the boxes
        themselves.

    Raises:
        UserError: the source cannot be read, a box cannot be tracked, or there is no such tracker.
    """
    if not len(boxes):
        raise UserError("boxes is empty: give x,y,w,h of at least one target on the first frame")
    with contextlib.ExitStack() as stack:
        if isinstance(source, str | int | Path):
            video = stack.enter_context(open_source(source))
            selected = shots(video, video.fps, span)
        else:
            selected = shots(source, FALLBACK_FPS, span)
        pool = TargetPool(tracker, options=options)
        stack.callback(pool.close)
        for _, frame in selected:
            yield list(_followed(pool, frame, boxes).values())


@dataclass(frozen=True)
class Outputs:
    """Files to write while targets are followed."""

    video: Path | None = None
    """frames with box, state and score, see `psiamfcpp.video.writer.SUFFIXES`"""
    boxes: Path | None = None
    """boxes as text, .csv or .jsonl, see `psiamfcpp.video.boxes.BoxWriter`"""
    overlay: Overlay = field(default_factory=Overlay)


def follow_to_files(
    frames: Iterable[Shot],
    pool: TargetPool,
    targets: Sequence[Box],
    fps: float,
    outputs: Outputs,
    every: int = 1,
    advance: Callable[[], None] = lambda: None,
) -> Followed:
    """Follow boxes through frames, and write video and boxes on the way.

    An interruption or a source that ends early ends it; what was written until then is complete. Drawing and encoding
    run in a thread of their own, beside the tracker.

    Args:
        frames: with their numbers, see `psiamfcpp.video.span.shots`.
        pool: what follows them; without targets yet.
        targets: the boxes on the first frame, at least one.
        fps: frames per second of the source.
        outputs: files to write.
        every: the frames are one in N of the source's; the video keeps its pace.
        advance: called after each frame.

    Raises:
        UserError: the first frame cannot be had, a box is wrong, or a file cannot be written.
    """
    result = Followed()
    read = iter(frames)
    with contextlib.ExitStack() as files:
        write: Callable[[Shot, dict[int, Track], float], None] | None = None
        try:
            while (shot := _next(read, result)) is not None:
                start = time.perf_counter()
                tracks = _followed(pool, shot.image, targets)
                result.seconds.append(time.perf_counter() - start)
                # Not before a box was accepted: a wrong one must not cost the files of an earlier run.
                write = write or files.enter_context(behind(_writer(outputs, shot, len(targets), fps, every, files)))
                result.size = (shot.image.shape[1], shot.image.shape[0])
                result.numbers.append(shot.number)
                result.tracks.append(list(tracks.values()))
                write(shot, tracks, result.fps)
                advance()
        except KeyboardInterrupt:
            if not result.tracks:
                raise
            result.ended = "interrupted"
    return result


def _writer(
    outputs: Outputs, first: Shot, targets: int, fps: float, every: int, files: contextlib.ExitStack
) -> Callable[[Shot, dict[int, Track], float], None]:
    """Open the files; return what writes a frame, its tracks and the speed until then to them."""
    size = (first.image.shape[1], first.image.shape[0])
    video = files.enter_context(VideoWriter(outputs.video, fps / every, size)) if outputs.video else None
    boxes = files.enter_context(BoxWriter(outputs.boxes, targets, fps)) if outputs.boxes else None
    trails: dict[int, deque[Box]] = {}
    length = max(1, round(_TRAIL_S * fps / every))

    def write(shot: Shot, tracks: dict[int, Track], speed: float) -> None:
        if boxes:
            boxes.write(shot.number, list(tracks.values()))
        if video is None:
            return
        image = draw_targets(shot.image, tracks, outputs.overlay, trails)
        video.write(image if outputs.overlay.no_fps else draw_status(image, [f"{speed:.0f} fps"]))
        for number, track in tracks.items() if outputs.overlay.trail else ():
            trails.setdefault(number, deque(maxlen=length)).append(track.box)

    return write


def _followed(pool: TargetPool, frame: Image, boxes: Sequence[ArrayLike]) -> dict[int, Track]:
    """Start the targets on the first frame that a pool sees; update them on the others."""
    return pool.update(frame) if pool.numbers else dict(pool.add(frame, box) for box in boxes)


def _next(frames: Iterator[Shot], result: Followed) -> Shot | None:
    """The next frame, or None at the end; once something was followed, a break is an end with its reason."""
    try:
        return next(frames, None)
    except UserError as error:
        if not result.tracks:
            raise
        result.ended = str(error)
        return None
