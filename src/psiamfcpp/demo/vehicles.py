"""Vehicles as a drone sees them, from straight above, and how they are drawn into an image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from psiamfcpp.geometry import Image

Affine = NDArray[np.float64]
Colour = tuple[int, int, int]

_DETAIL = 1.25
"""sprite pixels a ground pixel: about what the camera's nearest view shows, so that it seldom magnifies"""
_FINE = 8
"""sprites are drawn this much larger first and averaged down: smooth edges"""
_MARGIN = 3.0
_GLASS: Colour = (48, 40, 34)


@dataclass(frozen=True, slots=True)
class Sprite:
    """A vehicle that heads along +x, its centre at the origin, in ground pixels."""

    pixels: NDArray[np.float32]
    """``(h, w, 4)``: blue, green, red multiplied by alpha (0..255), and alpha (0..1)"""
    shadow: NDArray[np.float32]
    """the same, of the shadow"""
    placement: Affine
    """``(2, 3)``: from sprite pixels to ground pixels"""
    outline: NDArray[np.float64]
    """``(n, 2)``: points along the edge of the body"""


@cache
def car(colour: Colour) -> Sprite:
    """A saloon, 4.5 by 1.9 m (56 by 24 ground pixels), of a BGR colour."""
    sheet = _Sheet(56, 24, 4.5, colour)
    sheet.block((-20, 13), (-9.6, 9.6), _GLASS, 3.5)
    sheet.block((-13, 3.5), (-8.2, 8.2), _lit(colour, 1.12), 4.0)
    sheet.line((14, -8.5), (26, -7), _lit(colour, 0.8))
    sheet.line((14, 8.5), (26, 7), _lit(colour, 0.8))
    for side in (-1, 1):
        sheet.block((23.5, 27), (side * 8 - 2, side * 8 + 2), (215, 240, 245), 2.0)
        sheet.block((-27.5, -25.5), (side * 8 - 2.6, side * 8 + 2.6), (40, 30, 200), 2.0)
        sheet.block((8, 11), (side * 10.8 - 1.1, side * 10.8 + 1.1), _lit(colour, 0.6), 2.0)
    return sheet.sprite()


@cache
def van(colour: Colour) -> Sprite:
    """A delivery van, 5.5 by 2.2 m, of a BGR colour."""
    sheet = _Sheet(68, 27, 6.0, colour)
    sheet.block((16, 26), (-10.5, 10.5), _GLASS, 3.5)
    sheet.block((-32, 16), (-11.5, 11.5), _lit(colour, 1.06), 6.0)
    for x in (-24, -14, -4, 6):
        sheet.line((x, -10), (x, 10), _lit(colour, 0.9))
    for side in (-1, 1):
        sheet.block((30, 33), (side * 9 - 2, side * 9 + 2), (215, 240, 245), 2.0)
    return sheet.sprite()


@cache
def truck(colour: Colour) -> Sprite:
    """A lorry with a box, 10 by 2.5 m, its cab of a BGR colour."""
    sheet = _Sheet(122, 31, 9.0, (62, 60, 58))
    sheet.block((37, 61), (-14.5, 14.5), colour, 4.0)
    sheet.block((49, 56), (-12.5, 12.5), _GLASS, 3.5)
    sheet.block((-61, 34), (-15.5, 15.5), (222, 224, 224), 14.0)
    sheet.line((-61, 0), (34, 0), (198, 200, 200))
    return sheet.sprite()


def stamp(image: Image, layer: NDArray[np.float32], to_image: Affine, cover: tuple[Image, Affine] | None) -> float:
    """Draw a sprite's layer into an image, in place.

    Args:
        image: ``(H, W, 3)`` uint8 BGR.
        layer: ``pixels`` or ``shadow`` of a `Sprite`.
        to_image: ``(2, 3)``: from the layer's pixels to the image's.
        cover: what lies above: a mask (0 open .. 255 covered), ``(2, 3)`` from its pixels to the image's.

    Returns:
        The share of the layer that is not covered, 0 to 1; what lies outside the image does not count.
    """
    height, width = layer.shape[:2]
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]) @ to_image.T
    left, top = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 1, 0)
    right, bottom = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 2, image.shape[1::-1])
    if left >= right or top >= bottom:
        return 1.0
    shift, size = np.array([[0, 0, left], [0, 0, top]]), (int(right - left), int(bottom - top))
    patch = cv2.warpAffine(layer, to_image - shift, size, flags=cv2.INTER_LINEAR)
    alpha = patch[:, :, 3:]
    share = 1.0
    if cover is not None:
        mask = cv2.warpAffine(cover[0], cover[1] - shift, size, flags=cv2.INTER_LINEAR)[:, :, None]
        share = 1.0 - float(alpha[mask > 230].sum() / max(float(alpha.sum()), 1e-6))
        patch = patch * (1 - mask.astype(np.float32) / 255)
        alpha = patch[:, :, 3:]
    region = image[top:bottom, left:right]
    region[:] = np.rint(region * (1 - alpha) + patch[:, :, :3])
    return share


class _Sheet:
    """A large canvas in the vehicle's own coordinates: +x ahead, origin at its centre, ground pixels."""

    def __init__(self, length: float, width: float, squareness: float, colour: Colour) -> None:
        self._half = np.array([length, width]) / 2 + _MARGIN
        shape = tuple(round(2 * h * _DETAIL) * _FINE for h in self._half[::-1])
        self._canvas = np.zeros((*shape, 3), np.uint8)
        self._mask = np.zeros(shape, np.uint8)
        self.outline = _rounded((-length / 2, length / 2), (-width / 2, width / 2), squareness)
        self._fill(self._canvas, self.outline, colour)
        self._fill(self._mask, self.outline, (255, 255, 255))

    def block(self, x: tuple[float, float], y: tuple[float, float], colour: Colour, squareness: float) -> None:
        self._fill(self._canvas, _rounded(x, y, squareness), colour)

    def line(self, start: tuple[float, float], end: tuple[float, float], colour: Colour) -> None:
        points = self._to_canvas(np.array([start, end]))
        cv2.polylines(self._canvas, [points], False, colour, _FINE, cv2.LINE_AA, 4)

    def sprite(self) -> Sprite:
        height, width = (side // _FINE for side in self._mask.shape)
        # the sides of the body slope: they catch less light than its top
        depth = cv2.distanceTransform(self._mask, cv2.DIST_L2, 5) / (_FINE * _DETAIL)
        light = np.clip(0.72 + 0.1 * depth, 0, 1)[:, :, None]
        alpha = (self._mask / 255.0)[:, :, None]
        fine = np.concatenate([self._canvas * light * alpha, alpha], axis=2).astype(np.float32)
        pixels = np.asarray(cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA), np.float32)
        shadow = np.zeros_like(pixels)
        shadow[:, :, 3] = 0.5 * cv2.GaussianBlur(pixels[:, :, 3], (0, 0), 1.2)
        scale = 2 * self._half / (width, height)
        # pixel centres are whole numbers: the sprite's middle lies at (side - 1) / 2
        start = -scale * (np.array([width, height]) - 1) / 2
        placement = np.array([[scale[0], 0, start[0]], [0, scale[1], start[1]]])
        return Sprite(pixels, shadow, placement, self.outline)

    def _fill(self, canvas: Image, points: NDArray[np.float64], colour: Colour) -> None:
        cv2.fillPoly(canvas, [self._to_canvas(points)], colour, cv2.LINE_AA, 4)

    def _to_canvas(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        size = np.array(self._mask.shape[::-1])
        return np.rint(((points + self._half) / (2 * self._half) * size - 0.5) * 16).astype(np.int32)


def _rounded(x: tuple[float, float], y: tuple[float, float], squareness: float) -> NDArray[np.float64]:
    """A closed superellipse that fills the range; 2 is an ellipse, large values near a rectangle."""
    angle = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    unit = np.sign(unit) * np.abs(unit) ** (2 / squareness)
    low, high = np.array([x[0], y[0]]), np.array([x[1], y[1]])
    return (low + high) / 2 + unit * (high - low) / 2


def _lit(colour: Colour, factor: float) -> Colour:
    blue, green, red = (int(min(255, c * factor)) for c in colour)
    return blue, green, red
