"""The part of a source that is followed: from a moment, to a moment, one frame in N."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image


class Shot(NamedTuple):
    """A frame and its number in the source, from 0."""

    number: int
    image: Image


@dataclass(frozen=True)
class Span:
    """Part of a source. Moments are seconds (``5``, ``2.5``, ``1:30``) or frame numbers from 0 (``#120``)."""

    start: str = "0"
    """first frame to follow, on which the boxes are given: seconds (5, 2.5, 1:30) or a frame number from 0 (#120)"""
    stop: str | None = None
    """first frame that is not followed any more, in seconds or as a frame number; by default none"""
    every: int = 1
    """follow one frame in N"""


def frame_number(moment: str, fps: float) -> int:
    """Return the number of the frame at a moment: seconds, minutes and hours by the frame rate, or ``#NUMBER``.

    Raises:
        UserError: neither of the two, or a negative one.
    """
    if re.fullmatch(r"#[0-9]{1,9}", moment):
        return int(moment[1:])
    if re.fullmatch(r"([0-9]{1,4}:){0,2}[0-9]{1,9}(\.[0-9]*)?", moment):
        seconds = 0.0
        for part in moment.split(":"):
            seconds = 60 * seconds + float(part)
        return round(seconds * fps)
    raise UserError(f"{moment!r} is no moment: give seconds as 5, 2.5 or 1:30, or a frame number as '#120'")


def shots(frames: Iterable[Image], fps: float, span: Span = Span()) -> Iterator[Shot]:
    """Yield the frames of a span, with their numbers in the source.

    Frames before the first are decoded and passed over, so numbers are exact whatever the container says.

    Args:
        frames: of the source, from its first.
        fps: frames per second of the source.
        span: which of them.

    Raises:
        UserError: the span is no span, at once; or it begins after the last frame, when that was read.
    """
    if span.every < 1:
        raise UserError(f"every is {span.every}: give 1 to follow every frame, 2 for every second one")
    start = frame_number(span.start, fps)
    stop = None if span.stop is None else frame_number(span.stop, fps)
    if stop is not None and stop <= start:
        raise UserError(f"stop {span.stop} is not after start {span.start}: nothing would be followed")
    return _shots(frames, start, stop, span)


def _shots(frames: Iterable[Image], start: int, stop: int | None, span: Span) -> Iterator[Shot]:
    number = -1
    for number, image in enumerate(frames):
        if number == stop:
            return
        if number >= start and (number - start) % span.every == 0:
            yield Shot(number, image)
    if number < start and start:
        raise UserError(f"start {span.start} is after the last frame: the source has {number + 1} frames")
