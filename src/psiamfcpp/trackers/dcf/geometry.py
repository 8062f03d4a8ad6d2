"""Where correlation filters cut their patches, and how they resize and round.

Inside the filters a position is ``(row, column)``, **1-based**, as in the authors' MATLAB code: their floor and round
rules hold only so. Sizes are ``(rows, columns)``. `cut` alone turns to 0-based indices.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from psiamfcpp.geometry import Box, FloatArray
from psiamfcpp.trackers.dcf import resizing

Pixels = NDArray[Any]
"""``(rows, columns)`` or ``(rows, columns, 3)``, BGR, uint8 or float"""
Size = tuple[int, int]
"""``(rows, columns)``"""

# Beyond this an index is meaningless, and an int64 not far.
_FAR = 1e9


def round_half_away(value: ArrayLike) -> FloatArray:
    """Round as MATLAB does: halves away from zero (`numpy.round` takes them to even)."""
    value = np.asarray(value, np.float64)
    return np.trunc(value + np.copysign(0.5, value))


def whole(value: ArrayLike) -> Size:
    """Two floats that hold whole numbers as ints, each at least 1."""
    rows, columns = np.asarray(value, np.float64)
    return max(int(rows), 1), max(int(columns), 1)


def position_and_size(box: Box) -> tuple[FloatArray, FloatArray]:
    """Corner ``(y, x)`` and size ``(h, w)`` of a box, as float arrays."""
    x, y, w, h = box
    return np.array([y, x]), np.array([h, w])


def centred_box(position: FloatArray, size: FloatArray) -> Box:
    """Box of ECO-HC, STRCF and ARCF-HC: position of the centre and size, rounded."""
    return to_box(round_half_away(position - (size - 1) / 2), round_half_away(size))


def floored(box: Box) -> tuple[FloatArray, FloatArray]:
    """Centre ``(row, column)`` and size ``(h, w)`` of a first box as BACF and AutoTrack take them: whole pixels."""
    corner, size = position_and_size(box)
    size = np.maximum(np.floor(size), 1)
    return np.floor(corner + np.floor(size / 2)), size


def to_box(corner: ArrayLike, size: ArrayLike) -> Box:
    """Box of a corner ``(y, x)`` and a size ``(h, w)``; the inverse of `position_and_size`."""
    (y, x), (h, w) = np.asarray(corner, np.float64), np.asarray(size, np.float64)
    return float(x), float(y), float(w), float(h)


def cut(image: Pixels, first: ArrayLike, size: Size) -> Pixels:
    """Rows ``first .. first + size - 1``, beyond the border the nearest pixel.

    Args:
        image: ``(H, W)`` or ``(H, W, C)``.
        first: row and column of the first pixel, 0-based, whole; may lie anywhere.
        size: rows and columns.

    Returns:
        The patch; a view where it lies inside the image.
    """
    top, left = (int(v) for v in np.clip(np.asarray(first, np.float64), -_FAR, _FAR))
    (rows, columns), (height, width) = size, image.shape[:2]
    if top >= 0 and left >= 0 and top + rows <= height and left + columns <= width:
        return image[top : top + rows, left : left + columns]
    y0, y1 = (min(max(v, 0), height) for v in (top, top + rows))
    x0, x1 = (min(max(v, 0), width) for v in (left, left + columns))
    if y0 >= y1 or x0 >= x1:  # wholly outside
        across = np.clip(np.arange(top, top + rows), 0, height - 1)
        along = np.clip(np.arange(left, left + columns), 0, width - 1)
        return image[across[:, None], along]
    border = (y0 - top, top + rows - y1, x0 - left, left + columns - x1)
    return cv2.copyMakeBorder(image[y0:y1, x0:x1], *border, cv2.BORDER_REPLICATE)


def crop(image: Pixels, centre: ArrayLike, size: ArrayLike, shift: int = 0) -> Pixels:
    """Patch about a centre: indices ``floor(c) + (1 .. n) - floor((n + shift) / 2)``, the border replicated.

    Args:
        image: ``(H, W)`` or ``(H, W, C)``.
        centre: row and column, 1-based.
        size: rows and columns, floored; what is below 1 becomes 2, as in the authors' code.
        shift: 1 for ECO's rule, which lies one pixel aside for odd sizes.
    """
    n = np.floor(np.asarray(size, np.float64))
    n = np.where(n < 1, 2, n)
    first = np.floor(np.asarray(centre, np.float64)) - np.floor((n + shift) / 2)
    return cut(image, first, (int(n[0]), int(n[1])))


def resize_auto(patch: Pixels, size: Size) -> Pixels:
    """Resize as the authors' `mexResize(..., 'auto')`: bilinear if the new *width* exceeds the old *height*, else area.

    Args:
        patch: ``(h, w)`` or ``(h, w, C)``, uint8 or float.
        size: new rows and columns.
    """
    # Width against height is a slip of the original; published boxes depend on it.
    return _resize(patch, size, size[1] > patch.shape[0])


def resize_bilinear(patch: Pixels, size: Size) -> Pixels:
    """Resize bilinearly without antialiasing (ECO's rule); see `resize_auto`."""
    return _resize(patch, size, True)


def _resize(patch: Pixels, size: Size, linear: bool) -> Pixels:
    if patch.shape[:2] == size:
        return patch
    if patch.dtype != np.uint8:
        rule = cv2.INTER_LINEAR if linear else cv2.INTER_AREA
        return cv2.resize(patch, size[::-1], interpolation=rule)
    out = np.empty((*size, *patch.shape[2:]), np.uint8)
    planes = (np.ascontiguousarray(patch), out) if patch.ndim == 3 else (patch[..., None].copy(), out[..., None])
    height, width = patch.shape[:2]
    resizing.resize(planes[0], 0, 0, height, width, linear, planes[1])
    return out


def scale_limits(step: float, window: ArrayLike, base: ArrayLike, frame_size: ArrayLike) -> tuple[float, float]:
    """Smallest and largest scale factor: powers of the step that keep the window above 5 px, the target in the frame.

    Args:
        step: ratio of neighbouring scales.
        window: rows and columns of the template window in pixels.
        base: rows and columns of the target at scale 1.
        frame_size: rows and columns of the first frame.
    """
    window, base, frame = (np.asarray(v, np.float64) for v in (window, base, frame_size))
    low = math.ceil(math.log(float(np.max(5 / window))) / math.log(step))
    high = math.floor(math.log(float(np.min(frame / base))) / math.log(step))
    return step**low, step**high


def clamp_scale(scale: float, limits: tuple[float, float]) -> float:
    """The scale factor within its limits; where these cross, the larger bound holds."""
    return limits[0] if scale < limits[0] else min(scale, max(limits))


def is_grey(image: Pixels) -> bool:
    """Whether a sequence whose first frame this is counts as grey: red and green are equal everywhere."""
    return image.ndim == 2 or bool((image[..., 1] == image[..., 2]).all())
