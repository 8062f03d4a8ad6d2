"""A box for a point: what an operator who only taps on a target would have drawn."""

from __future__ import annotations

import math

import cv2
import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image

# Targets seen from the air are small: on rendered clips with targets of 35 to 70 pixels at 720 lines, a window of
# twice 1/11 of the shorter side found most of them; half as much cut them off.
_WINDOW = 1 / 11
# GrabCut's time grows with the area, so a larger window is looked at in less detail.
_DETAIL = 64
# Half of what is found must be background: else it was the ground that was tapped.
_LARGEST_SHARE = 0.8
_SMALLEST_SIDE = 4.0
_FALLBACK = 1 / 18


def propose_box(frame: Image, x: float, y: float) -> Box:
    """Return a box around what lies under a point, or a small square about the point where nothing is found.

    See `find_box` for the arguments and errors.
    """
    found = find_box(frame, x, y)
    if found is not None:
        return found
    side = min(frame.shape[:2]) * _FALLBACK
    return (x - (side - 1) / 2, y - (side - 1) / 2, side, side)


def find_box(frame: Image, x: float, y: float) -> Box | None:
    """Return a box around what lies under a point, or None where nothing there could be a target.

    GrabCut (Rother, Kolmogorov and Blake 2004) separates a window about the point into object and ground: the point is
    object, the window's rim is ground.

    Args:
        frame: ``(H, W, 3)`` uint8, BGR.
        x: column of the point, pixels.
        y: row of the point, pixels.

    Returns:
        ``(x, y, w, h)``, pixels, or None.

    Raises:
        UserError: the point is not finite, or outside the frame.
    """
    height, width = frame.shape[:2]
    if not (math.isfinite(x) and math.isfinite(y) and 0 <= x <= width - 1 and 0 <= y <= height - 1):
        raise UserError(f"point {x:g},{y:g} lies outside the frame ({width}x{height})")
    half = max(8, round(min(width, height) * _WINDOW))
    left, top = max(0, round(x) - half), max(0, round(y) - half)
    window = frame[top : round(y) + half + 1, left : round(x) + half + 1]
    scale = min(1.0, _DETAIL / half)
    if scale < 1:
        window = np.asarray(cv2.resize(window, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    found = _object(np.ascontiguousarray(window), round((x - left) * scale), round((y - top) * scale))
    if found is None:
        return None
    bx, by, bw, bh = found
    return (left + bx / scale, top + by / scale, bw / scale, bh / scale)


def _object(window: Image, column: int, row: int) -> Box | None:
    """The object at a pixel of a window, in its pixels; None where there is none of a target's size."""
    height, width = window.shape[:2]
    if min(height, width) < 12:
        return None
    column, row = min(column, width - 1), min(row, height - 1)
    size = max(height, width)
    rim, seed = max(2, size // 32), max(2, size // 40)
    mask = np.full((height, width), cv2.GC_PR_BGD, np.uint8)
    cv2.circle(mask, (column, row), size // 4, cv2.GC_PR_FGD, cv2.FILLED)
    mask[:rim] = mask[-rim:] = cv2.GC_BGD
    mask[:, :rim] = mask[:, -rim:] = cv2.GC_BGD
    cv2.circle(mask, (column, row), seed, cv2.GC_FGD, cv2.FILLED)
    cv2.setRNGSeed(0)  # GrabCut begins with k-means: the same tap gives the same box
    ground, thing = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(window, mask, (0, 0, 0, 0), ground, thing, 3, cv2.GC_INIT_WITH_MASK)
    inside = np.isin(mask, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)
    # What hangs on by a line of single pixels is shadow or marking.
    inside = np.asarray(cv2.morphologyEx(inside, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)), np.uint8)
    cv2.circle(inside, (column, row), seed, 1, cv2.FILLED)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(inside)
    x, y, w, h = (float(v) for v in stats[labels[row, column]][:4])
    if min(w, h) < max(_SMALLEST_SIDE, 2.0 * seed + 2) or max(w / width, h / height) > _LARGEST_SHARE:
        return None
    return (x, y, w, h)
