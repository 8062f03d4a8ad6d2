"""One step of SiamFC++'s tracking procedure, from score map and boxes to the new target; no state is kept here."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.crop import Colour, mean_colour, target_crop
from psiamfcpp.geometry import Image, context_side
from psiamfcpp.spec import ModelSpec, TrackingConstants

FloatMap = NDArray[np.floating]


@dataclass(frozen=True)
class Target:
    """Centre and size of the target in the frame, pixels."""

    cx: float
    cy: float
    w: float
    h: float


@dataclass(frozen=True)
class Estimate:
    """What one search region says."""

    target: Target
    """centre and size in the frame as the chosen cell gives them, before any smoothing"""
    score: float
    """score of the chosen cell, 0..1"""
    penalty: float
    """the chosen cell's factor for its change of size and shape, 0..1"""
    cell: tuple[int, int]
    """row and column of the chosen cell"""


@dataclass(frozen=True)
class Procedure:
    """What the published procedures of trackers differ in; `psiamfcpp.models.arch.Architecture.procedure` names it."""

    fill: Callable[[Image], Colour]
    """colour (BGR) of what lies outside the frame, from the first frame"""
    crop: Callable[[Image, Target, int, int, Colour, Image | None], Image]
    """frame, target, side of the crop, side of the template crop, fill, buffer: the crop, as `target_crop` gives it"""
    zoom: Callable[[Target, ModelSpec], float]
    """pixels of the crops for a pixel of the frame"""
    middle: Callable[[int], float]
    """pixel of a crop of a side at which the target's centre is, in x and in y"""
    window: Callable[[int], FloatMap]
    """the window ``(N, N)``"""
    estimate: Callable[[FloatMap, FloatMap, Target, ModelSpec, FloatMap], Estimate]
    """scores, boxes, target that the crop was centred on and scaled by, description, window: the chosen cell"""
    rate: Callable[[Estimate, TrackingConstants], float]
    """share of the way to the found size"""
    rate_in_doubt: float
    """share of that rate while the target is not surely seen; 0 keeps the size"""
    move: Callable[[Target, Estimate, float, tuple[int, ...], float], Target]
    """target so far, estimate, rate, shape of the frame, lower bound of the sides: the new target"""
    smallest: float
    """pixels; sides below are not followed down, unless the target began smaller"""


def cosine_window(cells: int) -> FloatMap:
    """The window ``(N, N)`` that favours small motion."""
    return np.outer(np.hanning(cells), np.hanning(cells))


def estimate(
    scores: FloatMap,
    boxes: FloatMap,
    previous: Target,
    search_size: int,
    template_size: int,
    constants: TrackingConstants,
    window: FloatMap,
) -> Estimate:
    """Choose a cell by penalised and windowed score, and map its box to the frame.

    Args:
        scores: ``(N, N)``.
        boxes: ``(N, N, 4)`` as x0, y0, x1, y1 in pixels of the crop.
        previous: the target that the crop was centred on and scaled by.
        search_size: side of the crop in pixels.
        template_size: side of the template in pixels.
        constants: penalty and window weight.
        window: what `cosine_window` gives.

    Returns:
        The estimate. As in the original, ``search_size // 2`` is the crop's centre.
    """
    scale = template_size / context_side(previous.w, previous.h)
    widths = np.maximum(boxes[..., 2] - boxes[..., 0] + 1, 1e-3)
    heights = np.maximum(boxes[..., 3] - boxes[..., 1] + 1, 1e-3)
    padding = (widths + heights) / 2
    size_change = _change(np.sqrt((widths + padding) * (heights + padding)) / template_size)
    shape_change = _change((previous.w / previous.h) / (widths / heights))
    penalty = np.exp(-(shape_change * size_change - 1) * constants.penalty_k)
    ranked = penalty * scores * (1 - constants.window_influence) + window * constants.window_influence
    row, column = divmod(int(ranked.argmax()), scores.shape[1])

    x0, y0, x1, y1 = (float(v) for v in boxes[row, column])
    middle = search_size // 2
    target = Target(
        previous.cx + ((x0 + x1) / 2 - middle) / scale,
        previous.cy + ((y0 + y1) / 2 - middle) / scale,
        float(widths[row, column]) / scale,
        float(heights[row, column]) / scale,
    )
    return Estimate(target, float(scores[row, column]), float(penalty[row, column]), (row, column))


def smooth(previous: Target, found: Estimate, rate: float, frame_shape: tuple[int, ...], smallest: float) -> Target:
    """The new target: the centre as found, the size moved towards the found one by ``rate``; kept inside the frame.

    Args:
        previous: the target so far.
        found: the estimate.
        rate: share of the way to the found size; `TrackingConstants.test_lr` * penalty * score in SiamFC++.
        frame_shape: ``(height, width, ...)``.
        smallest: lower bound of both sides, pixels.
    """
    height, width = frame_shape[:2]
    return Target(
        min(max(found.target.cx, 0.0), float(width)),
        min(max(found.target.cy, 0.0), float(height)),
        min(max(previous.w + (found.target.w - previous.w) * rate, smallest), float(width)),
        min(max(previous.h + (found.target.h - previous.h) * rate, smallest), float(height)),
    )


def hidden(scores: FloatMap, boxes: FloatMap, around: Target, seen: Target, scale: float, middle: float) -> FloatMap:
    """The scores ``(N, N)`` with 0 in every cell whose box has its centre in another box: what else is there?

    Args:
        scores: ``(N, N)``; left as they are.
        boxes: ``(N, N, 4)`` as x0, y0, x1, y1 in pixels of the crop.
        around: the target that the crop was centred on and scaled by.
        seen: the box to leave out, in the frame.
        scale: pixels of the crop for a pixel of the frame.
        middle: pixel of the crop, in x and in y, that shows the centre of ``around``.
    """
    cx, cy = _centres(boxes)
    dx = cx - middle - (seen.cx - around.cx) * scale
    dy = cy - middle - (seen.cy - around.cy) * scale
    inside = (np.abs(dx) < seen.w * scale / 2) & (np.abs(dy) < seen.h * scale / 2)
    return np.where(inside, 0, scores)


def contrast(scores: FloatMap, boxes: FloatMap, cell: tuple[int, int]) -> float:
    """Logarithm of the peak's score over the best score outside the peak's box: small where something else competes.

    Args:
        scores: ``(N, N)``.
        boxes: ``(N, N, 4)`` as x0, y0, x1, y1 in pixels of the crop.
        cell: row and column of the peak.
    """
    x0, y0, x1, y1 = boxes[cell]
    cx, cy = _centres(boxes)
    apart = (cx < x0) | (cx > x1) | (cy < y0) | (cy > y1)
    rest = float(scores[apart].max()) if apart.any() else 0.0
    return math.log((float(scores[cell]) + 1e-3) / (rest + 1e-3))


def _centres(boxes: FloatMap) -> tuple[FloatMap, FloatMap]:
    return (boxes[..., 0] + boxes[..., 2]) / 2, (boxes[..., 1] + boxes[..., 3]) / 2


def _change(ratio: FloatMap) -> FloatMap:
    return np.maximum(ratio, 1 / ratio)


def _crop(frame: Image, target: Target, size: int, template_size: int, fill: Colour, out: Image | None) -> Image:
    return target_crop(frame, (target.cx, target.cy, target.w, target.h), size, template_size, fill, out)


def _zoom(target: Target, spec: ModelSpec) -> float:
    return spec.template_size / context_side(target.w, target.h)


def _estimate(scores: FloatMap, boxes: FloatMap, previous: Target, spec: ModelSpec, window: FloatMap) -> Estimate:
    return estimate(scores, boxes, previous, spec.search_size, spec.template_size, spec.constants, window)


PROCEDURE = Procedure(
    fill=mean_colour,
    crop=_crop,
    zoom=_zoom,
    middle=lambda size: size // 2,
    window=cosine_window,
    estimate=_estimate,
    rate=lambda found, constants: constants.test_lr * found.penalty * found.score,
    rate_in_doubt=0.0,
    move=smooth,
    # The original's lower bound.
    smallest=10.0,
)
