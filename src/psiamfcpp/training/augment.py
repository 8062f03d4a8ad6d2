"""Changes of appearance that a camera makes: colour, grey, blur, low resolution, noise, compression, occlusion."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from psiamfcpp.geometry import Image

# Enough for the crops of searches up to 800 pixels.
_NORMAL_NUMBERS = 1 << 21


def photometric(image: Image, rng: Generator, strength: float = 1.0) -> Image:
    """A randomly changed copy of a crop ``(S, S, 3)``, uint8, BGR; ``strength`` 0 changes nothing."""
    for change, chance in _CHANGES:
        if rng.random() < chance * strength:
            image = change(image, rng)
    return image


def grey(image: Image) -> Image:
    """The crop without colour, still three channels."""
    return cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)  # type: ignore[return-value]


def occlude(image: Image, corners: tuple[float, float, float, float], rng: Generator) -> Image:
    """Cover one side of a target by a patch from elsewhere in the same crop.

    Args:
        image: ``(S, S, 3)``, uint8, BGR; not changed.
        corners: x0, y0, x1, y1 of the target in the crop.
        rng: source of chance.

    Returns:
        A copy, or the image itself where the target is too small to cover in part.
    """
    size = image.shape[0]
    x0, y0, x1, y1 = (int(np.clip(v, 0, size)) for v in corners)
    w, h = x1 - x0, y1 - y0
    share = rng.uniform(0.2, 0.5)
    if rng.random() < 0.5:
        pw, ph = int(w * share), h
    else:
        pw, ph = w, int(h * share)
    if min(pw, ph) < 4:
        return image
    px, py = (x0, y0) if rng.random() < 0.5 else (x1 - pw, y1 - ph)
    sx, sy = int(rng.integers(0, size - pw + 1)), int(rng.integers(0, size - ph + 1))
    covered = image.copy()
    covered[py : py + ph, px : px + pw] = image[sy : sy + ph, sx : sx + pw]
    return covered


def transplant(image: Image, corners: tuple[float, float, float, float], backdrop: Image) -> Image:
    """The target before another background, cut out along the ellipse in its box, with a soft rim.

    A moving target leaves the surroundings that its template shows, so the network must not rely on them.

    Args:
        image: ``(S, S, 3)``, uint8, BGR, with the target.
        corners: x0, y0, x1, y1 of the target in the crop.
        backdrop: ``(S, S, 3)``, uint8, BGR.
    """
    x0, y0, x1, y1 = corners
    rim = max(1.0, 0.04 * (x1 - x0 + y1 - y0))
    middle, axes = ((x0 + x1) / 2, (y0 + y1) / 2), ((x1 - x0) * 0.55, (y1 - y0) * 0.55)
    # Beyond three deviations of its rim the mask is 0: only what lies within is blended.
    left, top = (int(np.clip(m - a - 3 * rim - 2, 0, image.shape[0])) for m, a in zip(middle, axes, strict=True))
    right, bottom = (int(np.clip(m + a + 3 * rim + 3, 0, image.shape[0])) for m, a in zip(middle, axes, strict=True))
    changed = backdrop.copy()
    if right <= left or bottom <= top:
        return changed
    mask = np.zeros((bottom - top, right - left), np.float32)
    # Sub-pixel drawing: the last argument is the number of fractional bits.
    place, reach = (round((middle[0] - left) * 16), round((middle[1] - top) * 16)), tuple(round(a * 16) for a in axes)
    cv2.ellipse(mask, place, reach, 0, 0, 360, 1.0, cv2.FILLED, cv2.LINE_8, 4)
    share = np.asarray(cv2.GaussianBlur(mask, (0, 0), rim, borderType=cv2.BORDER_REPLICATE))
    part = (slice(top, bottom), slice(left, right))
    changed[part] = cv2.blendLinear(image[part], backdrop[part], share, 1 - share)
    return changed


def _colour(image: Image, rng: Generator) -> Image:
    """Gain, offset and gamma, mostly common to the channels, a little apart."""
    gain = rng.uniform(0.7, 1.35) * rng.uniform(0.9, 1.1, 3)
    offset = rng.uniform(-25, 25) + rng.uniform(-8, 8, 3)
    gamma = np.exp(rng.uniform(-0.35, 0.35))
    levels = (np.arange(256)[:, None] / 255) ** gamma * 255 * gain + offset
    table = np.clip(levels, 0, 255).astype(np.uint8)[None]
    return cv2.LUT(image, table)  # type: ignore[return-value]


def _saturation(image: Image, rng: Generator) -> Image:
    return _as_image(cv2.addWeighted(image, a := rng.uniform(0.3, 1.6), grey(image), 1 - a, 0))


def _blur(image: Image, rng: Generator) -> Image:
    return _as_image(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.6, 2.2)))


def _motion_blur(image: Image, rng: Generator) -> Image:
    length = int(rng.integers(3, 12))
    kernel = np.zeros((length, length), np.float32)
    angle = rng.uniform(0, np.pi)
    reach = (length - 1) / 2 * np.array([np.cos(angle), np.sin(angle)])
    middle = (length - 1) / 2
    start, end = np.round(middle - reach).astype(int), np.round(middle + reach).astype(int)
    cv2.line(kernel, start.tolist(), end.tolist(), 1.0)
    return _as_image(cv2.filter2D(image, -1, kernel / kernel.sum()))


def _low_resolution(image: Image, rng: Generator) -> Image:
    size = image.shape[0]
    small = max(16, int(size / rng.uniform(1.5, 4.5)))
    shrunk = cv2.resize(image, (small, small), interpolation=cv2.INTER_AREA)
    return _as_image(cv2.resize(shrunk, (size, size), interpolation=cv2.INTER_LINEAR))


def _noise(image: Image, rng: Generator) -> Image:
    # A piece of one long noise from a random place, far cheaper than drawing each crop's anew.
    noise, start = _normal_numbers(), int(rng.integers(_NORMAL_NUMBERS - image.size))
    piece = noise[start : start + image.size].reshape(image.shape)
    return _as_image(cv2.add(image, piece * np.float32(rng.uniform(2, 12)), dtype=cv2.CV_8U))


@functools.cache
def _normal_numbers() -> NDArray[np.float32]:
    return np.random.default_rng(0).standard_normal(_NORMAL_NUMBERS, dtype=np.float32)


def _compression(image: Image, rng: Generator) -> Image:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(20, 70))])
    return _as_image(cv2.imdecode(data, cv2.IMREAD_COLOR))


def _as_image(array: object) -> Image:
    return np.asarray(array, dtype=np.uint8)


_CHANGES = (
    (_low_resolution, 0.25),
    (_colour, 0.7),
    (_saturation, 0.3),
    (_blur, 0.1),
    (_motion_blur, 0.12),
    (_noise, 0.1),
    (_compression, 0.15),
)
