"""What is drawn onto a frame: the box with its label, and lines of status."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

import cv2
import numpy as np

from psiamfcpp.geometry import Box, Image

Colour = tuple[int, int, int]

STATE_COLOURS: dict[str, Colour] = {
    "tracking": (80, 200, 40),
    "unsure": (0, 180, 255),
    "lost": (50, 50, 230),
}
"""BGR"""

TARGET_COLOURS: tuple[Colour, ...] = (
    (80, 200, 40),
    (255, 160, 40),
    (60, 220, 250),
    (230, 90, 230),
    (40, 140, 255),
    (220, 220, 90),
    (150, 110, 255),
    (190, 190, 190),
)
"""BGR; of several targets, number 1 has the first"""

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_BLACK, _WHITE = (0, 0, 0), (255, 255, 255)
_FARTHEST = 2**15 - 1


class Shown(Protocol):
    """What is drawn of a target; `psiamfcpp.trackers.Track` is one."""

    @property
    def box(self) -> Box:
        """``(x, y, w, h)``, pixels."""
        ...

    @property
    def score(self) -> float | None:
        """How sure the tracker is."""
        ...

    @property
    def state(self) -> str | None:
        """tracking, unsure or lost."""
        ...


def target_colour(number: int) -> Colour:
    """The colour of a target by its number, from 1; BGR."""
    return TARGET_COLOURS[(number - 1) % len(TARGET_COLOURS)]


@dataclass(frozen=True)
class Overlay:
    """What is drawn beside the boxes."""

    no_fps: bool = False
    """leave the speed of tracking out of the video"""
    no_label: bool = False
    """draw boxes without number, state and score"""
    trail: bool = False
    """draw the way of each target over the last two seconds"""


def draw_targets(
    frame: Image,
    tracks: Mapping[int, Shown],
    overlay: Overlay = Overlay(),
    trails: Mapping[int, Sequence[Box]] = MappingProxyType({}),
) -> Image:
    """Return a copy of the frame with every target's box, state and score.

    One target alone has the colour of its state; several have a number and a colour each. The box of a lost target is
    dashed.

    Args:
        frame: ``(H, W, 3)`` uint8 BGR; left as it is.
        tracks: by the target's number.
        overlay: what is left out.
        trails: boxes of the frames before, oldest first, by the target's number; their centres are joined by a line.
    """
    image = frame.copy()
    for number, track in tracks.items():
        score = None if track.score is None else f"{track.score:.2f}"
        parts = [str(number) if len(tracks) > 1 else None, track.state, score]
        label = "" if overlay.no_label else " ".join(filter(None, parts))
        colour = STATE_COLOURS[track.state or "tracking"] if len(tracks) == 1 else target_colour(number)
        _draw_trail(image, [*trails.get(number, ()), track.box], colour)
        _draw(image, track.box, label, colour, dashed=track.state == "lost")
    return image


def draw(frame: Image, box: Box, label: str, colour: Colour = STATE_COLOURS["tracking"]) -> Image:
    """Return a copy of the frame with a box and, on a filled strip that stays inside the frame, its label.

    Args:
        frame: ``(H, W, 3)`` uint8 BGR; left as it is.
        box: ``(x, y, w, h)`` in pixels; may reach over the frame's edge. One that is not finite is not drawn.
        label: one line; none is drawn where it is empty.
        colour: of the outline and the strip, BGR.
    """
    image = frame.copy()
    _draw(image, box, label, colour)
    return image


def _draw(image: Image, box: Box, label: str, colour: Colour, dashed: bool = False) -> None:
    if not all(math.isfinite(v) for v in box):
        return
    height, width = image.shape[:2]
    scale = _scale(image)
    line = max(1, round(2 * scale))
    # OpenCV draws no coordinate beyond 16 bits
    x0, x1 = (round(min(max(v, -line), width - 1 + line)) for v in (box[0], box[0] + box[2] - 1))
    y0, y1 = (round(min(max(v, -line), height - 1 + line)) for v in (box[1], box[1] + box[3] - 1))
    if dashed:
        _draw_dashed(image, (x0, y0, x1, y1), colour, line)
    else:
        cv2.rectangle(image, (x0, y0), (x1, y1), colour, line)
    if not label:
        return
    text_width, text_height, pad = _measure(label, scale)
    strip_width, strip_height = text_width + 2 * pad, text_height + 2 * pad
    left = max(0, min(x0 - line // 2, width - strip_width))
    above, below = y0 - strip_height, y1 + 1
    # above the box, else below it, else over it: the label must never be cut off
    top = above if above >= 0 else min(below, height - strip_height)
    top = max(0, min(top, height - strip_height))
    cv2.rectangle(image, (left, top), (left + strip_width - 1, top + strip_height - 1), colour, cv2.FILLED)
    _put(image, label, (left + pad, top + pad + text_height), scale, _ink(colour))


def _draw_dashed(image: Image, corners: tuple[int, int, int, int], colour: Colour, line: int) -> None:
    """Draw a rectangle from its corners inwards, so that each corner shows however small the box is."""
    x0, y0, x1, y1 = corners
    dash = 4 * line
    for (ax, ay), (bx, by) in (((x0, y0), (x1, y0)), ((x0, y1), (x1, y1)), ((x0, y0), (x0, y1)), ((x1, y0), (x1, y1))):
        length = max(bx - ax, by - ay)
        for at in range(0, length + 1, 2 * dash):
            ends = (min(at + shift, length) / max(length, 1) for shift in (0, dash))
            start, end = ((round(ax + (bx - ax) * share), round(ay + (by - ay) * share)) for share in ends)
            cv2.line(image, start, end, colour, line)


def _draw_trail(image: Image, boxes: Sequence[Box], colour: Colour) -> None:
    centres = [(x + (w - 1) / 2, y + (h - 1) / 2) for x, y, w, h in boxes if all(map(math.isfinite, (x, y, w, h)))]
    if len(centres) > 1:
        points = np.clip(np.rint(centres), -_FARTHEST, _FARTHEST).astype(np.int32)
        cv2.polylines(image, [points], False, colour, max(1, round(_scale(image))), cv2.LINE_AA)


def draw_status(frame: Image, lines: list[str]) -> Image:
    """A copy of the frame with lines of text on a darkened panel at its top left.

    Args:
        frame: ``(H, W, 3)`` uint8 BGR; left as it is.
        lines: the text, from the top; nothing is drawn where there is none.
    """
    image = frame.copy()
    if not lines:
        return image
    scale = _scale(image)
    sizes = [_measure(text, scale) for text in lines]
    pad = sizes[0][2]
    step = max(size[1] for size in sizes) + 2 * pad
    panel = image[: step * len(lines) + pad, : max(size[0] for size in sizes) + 4 * pad]
    panel[:] = panel * 0.35
    for number, text in enumerate(lines, start=1):
        _put(image, text, (2 * pad, step * number), scale, _WHITE)
    return image


def _scale(image: Image) -> float:
    """1 for a frame of 720 lines."""
    return max(0.4, min(image.shape[:2]) / 720)


def _measure(text: str, scale: float) -> tuple[int, int, int]:
    """Width and height of a text, and the margin that it wants, in pixels."""
    (width, height), below = cv2.getTextSize(text, _FONT, 0.6 * scale, _weight(scale))
    # the tail of a "g" hangs below the text's own height
    return width, height, max(2, round(5 * scale), below + 1)


def _put(image: Image, text: str, origin: tuple[int, int], scale: float, colour: Colour) -> None:
    cv2.putText(image, text, origin, _FONT, 0.6 * scale, colour, _weight(scale), cv2.LINE_AA)


def _weight(scale: float) -> int:
    return max(1, round(1.4 * scale))


def _ink(colour: Colour) -> Colour:
    """Black or white, whichever reads better on the colour."""
    blue, green, red = colour
    return _BLACK if 0.114 * blue + 0.587 * green + 0.299 * red > 120 else _WHITE
