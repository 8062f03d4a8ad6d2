"""Follow boxes through a source: `follow` for Python users, `follow_to_files` behind `track` and `demo`."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image
from psiamfcpp.trackers import TargetPool, Track, TrackerOptions
from psiamfcpp.video.drawing import draw_status, draw_targets
from psiamfcpp.video.source import open_source
from psiamfcpp.video.writer import BoxWriter, VideoWriter
from psiamfcpp.zoo import DEFAULT_MODEL


@dataclass
class Followed:
    """What was found, frame by frame."""

    tracks: list[list[Track]] = field(default_factory=list)
    """frame by frame, in each the targets in the order of their boxes"""
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
) -> Iterator[list[Track]]:
    """Follow boxes through a video, frame by frame.

    Args:
        source: a video file, camera number, address, folder or glob of images (see `psiamfcpp.video.source`), or the
            frames themselves, each ``(H, W, 3)`` uint8, BGR.
        boxes: ``(x, y, w, h)`` of each target on the first frame, pixels, 0-based; at least one.
        tracker: our model, or any other tracker (see `psiamfcpp.open_tracker`).
        options: how our model runs.

    Yields:
        For each frame one track per box, in the order of the boxes; the first frame's are the boxes themselves.

    Raises:
        UserError: the source cannot be read, a box cannot be tracked, or there is no such tracker.
    """
    if not len(boxes):
        raise UserError("boxes is empty: give x,y,w,h of at least one target on the first frame")
    with contextlib.ExitStack() as stack:
        frames: Iterable[Image]
        frames = stack.enter_context(open_source(source)) if isinstance(source, str | int | Path) else source
        pool = TargetPool(tracker, options=options)
        stack.callback(pool.close)
        for frame in frames:
            tracks = pool.update(frame) if pool.numbers else dict(pool.add(frame, box) for box in boxes)
            yield list(tracks.values())


def follow_to_files(
    frames: Iterator[Image],
    pool: TargetPool,
    targets: Sequence[Box],
    fps: float,
    output: Path | None = None,
    boxes: Path | None = None,
    advance: Callable[[], None] = lambda: None,
) -> Followed:
    """Follow boxes through frames, and write video and boxes on the way.

    An interruption or a source that ends early ends it; what was written until then is complete.

    Args:
        frames: ``(H, W, 3)`` uint8, BGR.
        pool: what follows them; without targets yet.
        targets: the boxes on the first frame, at least one.
        fps: frame rate of the written video.
        output: video to write, with box, score, state and speed.
        boxes: text file to write, one ``x,y,w,h`` per line; with several targets, one file each (see `boxes_paths`).
        advance: called after each frame.

    Raises:
        UserError: the first frame cannot be had, a box is wrong, or a file cannot be written.
    """
    result = Followed()
    with contextlib.ExitStack() as files:
        video: VideoWriter | None = None
        box_files: list[BoxWriter] = []
        try:
            while (frame := _next(frames, result)) is not None:
                start = time.perf_counter()
                tracks = pool.update(frame) if result.tracks else dict(pool.add(frame, box) for box in targets)
                result.seconds.append(time.perf_counter() - start)
                if not result.tracks:
                    # Not before a box was accepted: a wrong one must not cost the files of an earlier run.
                    if output:
                        video = files.enter_context(VideoWriter(output, fps, (frame.shape[1], frame.shape[0])))
                    if boxes:
                        paths = boxes_paths(boxes, len(targets))
                        box_files = [files.enter_context(BoxWriter(path)) for path in paths]
                result.tracks.append(list(tracks.values()))
                for box_file, track in zip(box_files, tracks.values(), strict=False):
                    box_file.write(track.box)
                if video:
                    video.write(draw_status(draw_targets(frame, tracks), [f"{result.fps:.0f} fps"]))
                advance()
        except KeyboardInterrupt:
            if not result.tracks:
                raise
            result.ended = "interrupted"
    return result


def boxes_paths(path: Path, count: int) -> list[Path]:
    """The boxes file of each target: the path itself for one, ``boxes.1.txt``, ``boxes.2.txt``... for several."""
    if count == 1:
        return [path]
    return [path.with_name(f"{path.stem}.{number}{path.suffix}") for number in range(1, count + 1)]


def _next(frames: Iterator[Image], result: Followed) -> Image | None:
    """The next frame, or None at the end; once something was followed, a break is an end with its reason."""
    try:
        return next(frames, None)
    except UserError as error:
        if not result.tracks:
            raise
        result.ended = str(error)
        return None
