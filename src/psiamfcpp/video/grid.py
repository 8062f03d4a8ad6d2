"""A grid of coordinates over a frame, to read boxes from where no page can be opened."""

from __future__ import annotations

import cv2
import numpy as np

from psiamfcpp.geometry import Image

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_STEPS = (5, 10, 20, 25, 50, 100, 200, 250, 500, 1000)
# Pixels between two labels at least: "1000" in the smallest letters, and a margin.
_ROOM = 48
_PART = 5


def grid_step(width: int, height: int) -> int:
    """Pixels between two labelled lines: a round number, about a sixteenth of the longer side."""
    least = max(_ROOM, max(width, height) / 16)
    return next((step for step in _STEPS if step >= least), _STEPS[-1])


def draw_grid(frame: Image) -> Image:
    """Return a copy of the frame, of its size, with lines at round coordinates and their numbers at all four edges.

    Args:
        frame: ``(H, W, 3)`` uint8 BGR; left as it is.
    """
    height, width = frame.shape[:2]
    step = grid_step(width, height)
    image = _lines(frame, step // _PART, 0.12)
    image = _lines(image, step, 0.45)
    scale = max(0.4, min(width, height) / 1400)
    for x in range(step, width, step):
        for y in (0, height - 1):
            _label(image, str(x), x, y, scale)
    for y in range(step, height, step):
        for x in (0, width - 1):
            _label(image, str(y), x, y, scale)
    return image


def _lines(frame: Image, step: int, strength: float) -> Image:
    """Lines every ``step`` pixels: lighter on dark ground, darker on light ground, so that they are seen on any."""
    image = frame.copy()
    for part in (image[:, step::step], image[step::step]):
        ink = np.where(part.mean(axis=2, keepdims=True) < 128, 255, 0)
        part[:] = part * (1 - strength) + ink * strength
    return image


def _label(image: Image, text: str, x: int, y: int, scale: float) -> None:
    """Write a text about a point, kept inside the image, on a filled strip."""
    height, width = image.shape[:2]
    (wide, high), below = cv2.getTextSize(text, _FONT, scale, 1)
    pad = 2
    left = min(max(0, x - wide // 2 - pad), max(0, width - wide - 2 * pad))
    top = min(max(0, y - high // 2 - pad), max(0, height - high - below - 2 * pad))
    corner = (left + wide + 2 * pad, top + high + below + 2 * pad)
    cv2.rectangle(image, (left, top), corner, (0, 0, 0), cv2.FILLED)
    cv2.putText(image, text, (left + pad, top + pad + high), _FONT, scale, (255, 255, 255), 1, cv2.LINE_AA)
