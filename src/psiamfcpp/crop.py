"""Square crops by one affine warp, and the mean colour that fills what lies outside the frame."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from psiamfcpp.geometry import Image, context_side

Colour = tuple[float, float, float]


def mean_colour(frame: Image) -> Colour:
    """Channel means (BGR) of a frame ``(H, W, 3)``: the fill of SiamFC for what lies outside of it."""
    b, g, r, _ = cv2.mean(frame)
    return (b, g, r)


def target_crop(
    frame: Image,
    target: tuple[float, float, float, float],
    size: int,
    template_size: int,
    fill: Colour,
    out: Image | None = None,
) -> Image:
    """The crop about a target that a template or a search branch is given.

    Args:
        frame: ``(H, W, 3)`` uint8, BGR.
        target: centre and size ``(cx, cy, w, h)`` in the frame.
        size: side of the crop in pixels; a crop of ``template_size`` holds the target with its context.
        template_size: side of a template crop in pixels.
        fill: colour (BGR) of what lies outside the frame.
        out: buffer ``(size, size, 3)`` to write to.

    Returns:
        ``(size, size, 3)`` uint8, BGR; ``out`` itself if given.
    """
    cx, cy, w, h = target
    return crop(frame, cx, cy, round(context_side(w, h) * size / template_size), size, fill, out)


def crop(frame: Image, cx: float, cy: float, side: float, size: int, fill: Colour, out: Image | None = None) -> Image:
    """The square of ``side`` pixels about a centre, resized to ``size``.

    SiamFC++'s convention, which official weights rely on: the centres of the square's corner pixels map to the
    centres of the output's corner pixels, so the scale is ``(side - 1) / (size - 1)``.

    Args:
        frame: ``(H, W, 3)`` uint8, BGR.
        cx: column of the centre in the frame, sub-pixel.
        cy: row of the centre in the frame, sub-pixel.
        side: side of the square in frame pixels.
        size: side of the output in pixels.
        fill: colour (BGR) of what lies outside the frame.
        out: buffer ``(size, size, 3)`` to write to.

    Returns:
        ``(size, size, 3)`` uint8, BGR; ``out`` itself if given.
    """
    scale = (side - 1) / (size - 1)
    to_frame = np.array([[scale, 0, cx - (side - 1) / 2], [0, scale, cy - (side - 1) / 2]])
    return warp(frame, to_frame, size, fill, out)


def warp(frame: Image, to_frame: NDArray[np.float64], size: int, fill: Colour, out: Image | None = None) -> Image:
    """A square output of which ``to_frame`` (2x3) maps each pixel ``(x, y)`` to its place in the frame."""
    return cv2.warpAffine(  # type: ignore[return-value]
        frame,
        to_frame,
        (size, size),
        dst=out,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=fill,
    )
