"""One step of LightFC's published procedure (Li et al. 2024; the crops are OSTrack's, Ye et al. 2022)."""

from __future__ import annotations

import math

import numpy as np

from psiamfcpp.crop import Colour, warp
from psiamfcpp.geometry import Image
from psiamfcpp.spec import ModelSpec
from psiamfcpp.trackers.siamfcpp.procedure import Estimate, FloatMap, Procedure, Target

# Side of a template crop over the square root of the target's area; a search crop has as much more as its pixels.
_CONTEXT = 2


def window(cells: int) -> FloatMap:
    """The window ``(N, N)`` that favours small motion: Hann's, without the zeros at its ends."""
    line = 0.5 * (1 - np.cos(2 * np.pi * np.arange(1, cells + 1) / (cells + 1)))
    return np.outer(line, line)


def crop(frame: Image, target: Target, size: int, template_size: int, fill: Colour, out: Image | None = None) -> Image:
    """The crop about a target: a square of whole pixels, resized.

    Args:
        frame: ``(H, W, 3)`` uint8, BGR.
        target: centre and size in the frame.
        size: side of the crop in pixels.
        template_size: side of a template crop in pixels.
        fill: colour (BGR) of what lies outside the frame.
        out: buffer ``(size, size, 3)`` to write to.

    Returns:
        ``(size, size, 3)`` uint8, BGR; ``out`` itself if given.
    """
    side = _side(target, size, template_size)
    left, top = (round(centre + 0.5 - side / 2) for centre in (target.cx, target.cy))
    scale = side / size
    # Edges of the square map to edges of the output, as an image is resized.
    offset = scale / 2 - 0.5
    return warp(frame, np.array([[scale, 0, left + offset], [0, scale, top + offset]]), size, fill, out)


def estimate(scores: FloatMap, boxes: FloatMap, previous: Target, spec: ModelSpec, window: FloatMap) -> Estimate:
    """Choose the cell of the highest windowed score, and map its box to the frame.

    Args:
        scores: ``(N, N)``.
        boxes: ``(N, N, 4)`` as x0, y0, x1, y1 in pixels of the crop.
        previous: the target that the crop was centred on and scaled by.
        spec: the model's description.
        window: what `window` gives.

    Returns:
        The estimate; there is no penalty. As in the original, the crop's middle is the target's centre, although its
        corner was rounded.
    """
    row, column = divmod(int((scores * window).argmax()), scores.shape[1])
    x0, y0, x1, y1 = (float(v) for v in boxes[row, column])
    zoom, middle = _zoom(previous, spec), _middle(spec.search_size)
    target = Target(
        previous.cx + ((x0 + x1) / 2 - middle) / zoom,
        previous.cy + ((y0 + y1) / 2 - middle) / zoom,
        (x1 - x0 + 1) / zoom,
        (y1 - y0 + 1) / zoom,
    )
    return Estimate(target, float(scores[row, column]), 1.0, (row, column))


def clip(previous: Target, found: Estimate, rate: float, frame_shape: tuple[int, ...], smallest: float) -> Target:
    """The new target: the found box, cut at the frame's edges.

    Args:
        previous: the target so far.
        found: the estimate.
        rate: share of the way to the found size; 1 in LightFC.
        frame_shape: ``(height, width, ...)``.
        smallest: lower bound of both sides, pixels.
    """
    t, (height, width) = found.target, frame_shape[:2]
    w, h = previous.w + (t.w - previous.w) * rate, previous.h + (t.h - previous.h) * rate
    (cx, w), (cy, h) = _cut(t.cx, w, width, smallest), _cut(t.cy, h, height, smallest)
    return Target(cx, cy, w, h)


def _cut(centre: float, side: float, length: int, smallest: float) -> tuple[float, float]:
    """Centre and side of what lies within ``length`` pixels, at least ``smallest`` of them."""
    low = min(max(centre + 0.5 - side / 2, 0.0), length - smallest)
    high = max(min(centre + 0.5 + side / 2, float(length)), low + smallest)
    return (low + high - 1) / 2, high - low


def _side(target: Target, size: int, template_size: int) -> int:
    """Side in pixels of the square in the frame that a crop shows."""
    return max(math.ceil(math.sqrt(target.w * target.h) * _CONTEXT * size / template_size), 1)


def _zoom(target: Target, spec: ModelSpec) -> float:
    return spec.search_size / _side(target, spec.search_size, spec.template_size)


def _middle(size: int) -> float:
    return (size - 1) / 2


def _black(frame: Image) -> tuple[float, float, float]:
    """Return the colour beyond the frame; named, since loaders in other processes receive it."""
    return (0.0, 0.0, 0.0)


PROCEDURE = Procedure(
    fill=_black,
    crop=crop,
    zoom=_zoom,
    middle=_middle,
    window=window,
    estimate=estimate,
    rate=lambda found, constants: 1.0,
    # Sizes are not smoothed: one that is kept goes out of date within frames.
    rate_in_doubt=1.0,
    move=clip,
    smallest=1.0,
)
