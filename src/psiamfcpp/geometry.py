"""Box formats, overlap and centre error.

Everywhere in this package a box is ``(x, y, w, h)``: floats, pixels, 0-based, and the width counts pixels, so that
the last column is ``x + w - 1`` and the centre is ``x + (w - 1) / 2`` (the convention of SiamFC++ and of the OTB
toolkit). Every function takes arrays of any leading shape, the four numbers last.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from psiamfcpp.errors import UserError

Box = tuple[float, float, float, float]
FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]
"""``(height, width, 3)``, BGR"""


def centre(boxes: ArrayLike) -> FloatArray:
    """Centres ``(..., 2)`` of boxes ``(..., 4)``, in pixels."""
    b = np.asarray(boxes, dtype=np.float64)
    return b[..., :2] + (b[..., 2:] - 1) / 2


def from_centre(cx: float, cy: float, w: float, h: float) -> Box:
    """The box ``(x, y, w, h)`` with the given centre and size; the inverse of `centre`."""
    return (cx - (w - 1) / 2, cy - (h - 1) / 2, w, h)


def to_centre(box: ArrayLike) -> tuple[float, float, float, float]:
    """Return centre and size ``(cx, cy, w, h)`` of a box ``(x, y, w, h)``; the inverse of `from_centre`."""
    (cx, cy), (_, _, w, h) = centre(box), np.asarray(box, dtype=np.float64)
    return float(cx), float(cy), float(w), float(h)


def from_corners(corners: ArrayLike) -> FloatArray:
    """Boxes ``(..., 4)`` of corner form ``(x0, y0, x1, y1)``, last column and row included."""
    c = np.asarray(corners, dtype=np.float64)
    return np.concatenate([c[..., :2], c[..., 2:] - c[..., :2] + 1], axis=-1)


def overlap(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Intersection over union of boxes ``(..., 4)`` with boxes ``(..., 4)``, broadcast; 0 where a box is empty."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    low = np.maximum(a[..., :2], b[..., :2])
    high = np.minimum(a[..., :2] + a[..., 2:], b[..., :2] + b[..., 2:])
    inter = np.prod(np.clip(high - low, 0, None), axis=-1)
    union = np.prod(np.clip(a[..., 2:], 0, None), axis=-1) + np.prod(np.clip(b[..., 2:], 0, None), axis=-1) - inter
    return np.divide(inter, union, out=np.zeros_like(inter), where=union > 0)


def centre_error(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Distance in pixels between the centres of boxes ``(..., 4)``, broadcast."""
    return np.linalg.norm(centre(a) - centre(b), axis=-1)


def check_frame(frame: Image) -> None:
    """Refuse anything but an image ``(H, W, 3)`` uint8.

    Raises:
        UserError: it is another kind of array, an empty one, or no array at all.
    """
    is_array = isinstance(frame, np.ndarray) and frame.dtype == np.uint8 and frame.size > 0
    if not is_array or frame.ndim != 3 or frame.shape[2] != 3:
        shape = f"{frame.dtype} {frame.shape}" if isinstance(frame, np.ndarray) else type(frame).__name__
        raise UserError(f"frame is {shape}: an array (height, width, 3) of uint8, BGR, is needed")


def check_box(box: ArrayLike, frame_shape: tuple[int, ...]) -> Box:
    """The box as four floats, if it is one that can be tracked in a frame.

    Args:
        box: ``(x, y, w, h)`` in pixels.
        frame_shape: ``(height, width, ...)`` of the frame.

    Returns:
        The box.

    Raises:
        UserError: not four finite numbers, a side below one pixel, or a centre outside the frame.
    """
    values = np.asarray(box, dtype=np.float64).ravel()
    if values.size != 4 or not np.isfinite(values).all():
        raise UserError(f"box {_text(values)} is not four finite numbers: give x,y,w,h in pixels")
    x, y, w, h = (float(v) for v in values)
    if w < 1 or h < 1:
        raise UserError(f"box {_text(values)} holds no pixel: width and height must be at least 1")
    height, width = frame_shape[:2]
    cx, cy = centre(values)
    if not (0 <= cx <= width - 1 and 0 <= cy <= height - 1):
        raise UserError(f"box {_text(values)} lies outside the frame ({width}x{height}): its centre must be inside")
    return (x, y, w, h)


def context_side(w: float, h: float) -> float:
    """Side in pixels of the square that holds a target of size ``w`` by ``h`` with its context.

    ``sqrt((w + p)(h + p))`` with ``p = (w + h) / 2`` (SiamFC, section 3.1; SiamFC++ keeps it).
    """
    p = (w + h) / 2
    return math.sqrt((w + p) * (h + p))


def _text(values: FloatArray) -> str:
    return ",".join(f"{v:g}" for v in values)
