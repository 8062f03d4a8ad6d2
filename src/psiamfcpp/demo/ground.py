"""The land below the demo clip: fields, woods, houses and two roads, one over the other."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from psiamfcpp.geometry import Image

Points = NDArray[np.float64]

SIDE = 3600
"""of the land, in ground pixels; 12.4 of them are a metre"""
LANE = 41.0
SUN = np.array([6.0, 8.0])
"""where a car's shadow falls, in ground pixels"""

_MAIN_WIDTH, _BRIDGE_WIDTH = 4 * LANE + 30, 2 * LANE + 52
_SPAN = 175
"""half the length of the bridge"""
_WHITE, _ASPHALT = (205, 212, 214), (92, 90, 88)
_CROPS = [
    (62, 112, 92), (58, 128, 98), (70, 140, 118), (52, 98, 78),
    (92, 158, 164), (118, 176, 190), (84, 120, 148),
]  # fmt: skip
_ROOFS = [(58, 74, 150), (64, 88, 170), (84, 84, 96), (70, 66, 72), (96, 112, 150)]


@dataclass(frozen=True, slots=True)
class Road:
    """A smooth curve, one point a ground pixel along it."""

    points: Points
    headings: NDArray[np.float64]
    """radians, 0 along +x, growing towards +y"""

    def at(self, distance: float, offset: float = 0.0) -> tuple[float, float, float]:
        """Place and heading ``(x, y, radians)`` at a distance along the road, ``offset`` to its right."""
        along = np.arange(len(self.points))
        x, y = (float(np.interp(distance, along, self.points[:, i])) for i in (0, 1))
        heading = float(np.interp(distance, along, self.headings))
        return x - offset * np.sin(heading), y + offset * np.cos(heading), heading

    def beside(self, offset: float) -> Points:
        """The curve that runs ``offset`` to the right of the road."""
        right = np.stack([-np.sin(self.headings), np.cos(self.headings)], axis=1)
        return self.points + offset * right

    def nearest(self, point: Points) -> int:
        """The distance along the road of its point nearest to another."""
        return int(np.argmin(np.linalg.norm(self.points - point, axis=1)))


@dataclass(frozen=True, slots=True)
class Land:
    """What the camera flies over."""

    texture: Image
    """``(SIDE, SIDE, 3)`` uint8 BGR"""
    cover: Image
    """what hides a car below the bridge: 255 below its deck, less in its shadow, 0 elsewhere"""
    cover_origin: Points
    """place of the mask's first pixel on the texture"""
    main: Road
    """four lanes; passes below the bridge"""
    crossing: Road
    """two lanes; over the bridge"""
    bridge: Points
    """the middle of the bridge"""
    yards: list[tuple[float, float, float]]
    """``(x, y, heading)`` of places where cars are parked"""


def build(rng: np.random.Generator) -> Land:
    """The land of a generator's state; the roads run alike in all, the rest is drawn by lot."""
    sway = rng.uniform(-60, 60, (3, 2))
    main = _road([(-900, 1400), (500, 1120), (1150, 1150), (1750, 1520), (2250, 1600) + sway[0] / 2,
                  (2640, 2000), (2470, 2560) + sway[1], (2100, 3000), (2000, 4500)])  # fmt: skip
    crossing = _road([(1750, -900), (1800, 700) + sway[2], (1980, 1500), (1830, 2500), (1550, 4500)])
    gaps = sum(np.subtract.outer(main.points[:, i], crossing.points[::4, i]) ** 2 for i in (0, 1))
    bridge = main.points[int(np.argmin(np.min(gaps, axis=1)))]

    image = _fields(rng)
    _pond(image, np.array([1180.0, 2420.0]), rng)
    taken = np.zeros((SIDE, SIDE), np.uint8)
    for road, width in ((main, _MAIN_WIDTH), (crossing, _BRIDGE_WIDTH)):
        _stroke(taken, road.points, (255, 255, 255), width + 50)
    cv2.circle(taken, (1180, 2420), 330, 255, cv2.FILLED)
    _main_road(image, main)
    cover, origin = _crossing_road(image, crossing, bridge)
    yards = _houses(image, taken, crossing, rng)
    _trees(image, taken, rng)
    return Land(_grained(image, rng), cover, origin, main, crossing, bridge, yards)


def _road(corners: list[tuple[float, float] | Points]) -> Road:
    """A curve that cuts the corners of a polyline."""
    knots = np.array([np.asarray(c, dtype=float) for c in corners])
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    along = np.arange(0, length[-1])
    window = np.hanning(700)
    window /= window.sum()
    rough = [np.interp(along, length, knots[:, i]) for i in (0, 1)]
    smooth = np.stack([np.convolve(r, window, mode="valid") for r in rough], axis=1)
    step = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])
    even = np.arange(0, step[-1])
    points = np.stack([np.interp(even, step, smooth[:, i]) for i in (0, 1)], axis=1)
    direction = np.gradient(points, axis=0)
    return Road(points, np.unwrap(np.arctan2(direction[:, 1], direction[:, 0])))


def _noise(rng: np.random.Generator, side: int, cells: int) -> NDArray[np.float32]:
    """Smooth noise ``(side, side)`` of unit spread, with a number of bumps per side."""
    coarse = rng.standard_normal((cells, cells)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC), np.float32)


def _fields(rng: np.random.Generator) -> NDArray[np.uint8]:
    half = SIDE // 2
    image = np.zeros((half, half, 3), np.float32)
    rows, columns = np.mgrid[0:half, 0:half].astype(np.float32)
    turn = rng.uniform(0.15, 0.6)
    hedges = np.zeros((half, half), np.uint8)
    for low, high in _split(np.full(2, -0.75 * half), np.full(2, 0.75 * half), rng):
        corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
        spin = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        polygon = np.rint(corners @ spin + half / 2).astype(np.int32)
        x0, y0 = np.clip(polygon.min(axis=0), 0, half)
        x1, y1 = np.clip(polygon.max(axis=0) + 1, 0, half)
        if x0 >= x1 or y0 >= y1:
            continue
        mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
        cv2.fillPoly(mask, [polygon - (x0, y0)], 1)
        angle, period = turn + rng.choice([0, np.pi / 2]), rng.uniform(5, 11)
        phase = columns[y0:y1, x0:x1] * np.cos(angle) + rows[y0:y1, x0:x1] * np.sin(angle)
        stripes = 1 + rng.uniform(0.0, 0.07) * np.sin(phase * (2 * np.pi / period))
        crop = np.array(_CROPS[rng.integers(len(_CROPS))], np.float32) * rng.uniform(0.85, 1.12)
        region = image[y0:y1, x0:x1]
        np.copyto(region, stripes[:, :, None] * crop, where=mask[:, :, None] > 0)
        cv2.polylines(hedges, [polygon], True, 255, 5, cv2.LINE_AA)
    rough = _noise(rng, half, 300) + 0.6
    weight = (hedges / 255.0 * np.clip(rough, 0, 1))[:, :, None].astype(np.float32)
    image = image * (1 - weight) + np.array([38, 72, 56], np.float32) * weight
    shade = 1 + 0.05 * _noise(rng, half, 9) + 0.04 * _noise(rng, half, 60) + 0.045 * _noise(rng, half, 420)
    image *= shade[:, :, None]
    full = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_LINEAR)
    return np.clip(full, 0, 255, out=full).astype(np.uint8)


def _split(low: Points, high: Points, rng: np.random.Generator) -> list[tuple[Points, Points]]:
    """A rectangle cut into fields, the longer side first."""
    sides = high - low
    axis = int(np.argmax(sides))
    if sides[axis] < rng.uniform(260, 520):
        return [(low, high)]
    cut = low[axis] + sides[axis] * rng.uniform(0.35, 0.65)
    left, right = high.copy(), low.copy()
    left[axis] = right[axis] = cut
    return _split(low, left, rng) + _split(right, high, rng)


def _pond(image: Image, centre: Points, rng: np.random.Generator) -> None:
    angle = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    bumps = np.zeros_like(angle)
    for waves in (2, 3, 5, 7):
        bumps += rng.uniform(0.02, 0.09) * np.sin(waves * angle + rng.uniform(0, 6))
    rim = np.stack([np.cos(angle) * 250, np.sin(angle) * 170], axis=1) * (1 + bumps)[:, None]
    for scale, colour in (
        (1.12, (70, 112, 104)),
        (1.04, (96, 138, 148)),
        (1.0, (112, 104, 74)),
        (0.9, (104, 92, 60)),
    ):
        _fill(image, centre + rim * scale, colour)


def _main_road(image: Image, road: Road) -> None:
    _stroke(image, road.points, (98, 136, 138), _MAIN_WIDTH + 34)
    _stroke(image, road.points, _ASPHALT, _MAIN_WIDTH)
    for lane in (-1.5, -0.5, 0.5, 1.5):
        for wheel in (-9, 9):
            _stroke(image, road.beside(lane * LANE + wheel), (86, 84, 82), 7)
    for side in (-1, 1):
        _stroke(image, road.beside(side * (2 * LANE + 4)), _WHITE, 3)
        _stroke(image, road.beside(side * 3.0), _WHITE, 2)
        _dashes(image, road.beside(side * LANE), 46, 72)


def _crossing_road(image: Image, road: Road, bridge: Points) -> tuple[Image, Points]:
    """Draw the road that crosses on the bridge, and hand back what it hides and the place of that mask."""
    middle = road.nearest(bridge)
    span = slice(middle - _SPAN, middle + _SPAN)
    shadow = np.zeros(image.shape[:2], np.uint8)
    _fill(shadow, _band(road, span, _BRIDGE_WIDTH) + 4.5 * SUN, (255, 255, 255))
    shadow = np.asarray(cv2.GaussianBlur(shadow, (0, 0), 3), np.uint8)
    origin = np.rint(bridge) - 400
    x, y = origin.astype(int)
    # the shadow lies inside the mask's window
    window = (slice(y, y + 800), slice(x, x + 800))
    image[window] = (image[window] * (1 - 0.5 * (shadow[window] / 255.0))[:, :, None]).astype(np.uint8)
    hidden = np.zeros_like(shadow)
    _fill(hidden, _band(road, span, _BRIDGE_WIDTH), (255, 255, 255))

    for bank in (road.points[: span.start], road.points[span.stop :]):
        _stroke(image, bank, (94, 134, 132), _BRIDGE_WIDTH + 16)
        _stroke(image, bank, _ASPHALT, 2 * LANE + 24)
    _fill(image, _band(road, span, _BRIDGE_WIDTH), (150, 154, 156))
    _fill(image, _band(road, slice(span.start + 6, span.stop - 6), 2 * LANE + 28), (100, 98, 96))
    for side in (-1, 1):
        _stroke(image, road.beside(side * (LANE + 3)), _WHITE, 3)
        rail = road.beside(side * (_BRIDGE_WIDTH / 2 - 4))[span]
        _stroke(image, rail + 0.35 * SUN, (104, 106, 108), 4)
        _stroke(image, rail, (196, 200, 202), 4)
    _dashes(image, road.points, 46, 72)
    return np.maximum(hidden[window], (shadow[window] * 0.45).astype(np.uint8)), origin


def _houses(image: Image, taken: Image, road: Road, rng: np.random.Generator) -> list[tuple[float, float, float]]:
    yards = []
    for distance in np.arange(500, len(road.points) - 500, 190):
        for side in (-1, 1):
            x, y, heading = road.at(distance + rng.uniform(-40, 40), side * rng.uniform(205, 260))
            half = np.array([rng.uniform(62, 95), rng.uniform(46, 62)])
            spot = (slice(int(max(y - 110, 0)), int(y + 110)), slice(int(max(x - 110, 0)), int(x + 110)))
            if rng.random() < 0.35 or not taken[spot].size or taken[spot].any():
                continue
            axes = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
            place = np.array([x, y])
            lawn = place + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (half + 32) @ axes
            _fill(image, lawn, (72, 132, 108))
            drive = place + np.array([[half[0] + 14, 0], [half[0] + 14, -side * 170]]) @ axes
            _stroke(image, drive, (128, 134, 138), 30)
            _roof(image, place, half, axes, _ROOFS[rng.integers(len(_ROOFS))])
            cv2.circle(taken, (int(x), int(y)), 150, 255, cv2.FILLED)
            parked = place + np.array([half[0] + 14, -side * 30.0]) @ axes
            yards.append((float(parked[0]), float(parked[1]), heading + np.pi / 2))
    return yards


def _roof(image: Image, place: Points, half: Points, axes: Points, colour: tuple[int, int, int]) -> None:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half @ axes
    for step in np.linspace(0.2, 0.95, 11):
        _darken(image, place + corners + step * 3.2 * SUN, 0.93)
    ridge = np.array([[-1, 0], [1, 0]]) * half @ axes
    for edge, (a, b) in enumerate(((0, 1), (2, 3))):
        slope = np.array([corners[a], corners[b], ridge[1 - edge], ridge[edge]])
        facing = float(-(slope[:2].mean(axis=0)) @ SUN) / (np.linalg.norm(SUN) * half[1])
        tone = 0.95 + 0.22 * facing
        _fill(image, place + slope, tuple(c * tone for c in colour))
        for part in np.linspace(0.15, 0.9, 6):
            row = slope[:2] * (1 - part) + slope[[3, 2]] * part
            _stroke(image, place + row, tuple(c * tone * 0.93 for c in colour), 1)
    _stroke(image, place + ridge, tuple(min(255, c * 1.25) for c in colour), 2)
    chimney = np.array([[-5, -5], [5, -5], [5, 5], [-5, 5]]) + np.array([half[0] * 0.5, half[1] * 0.4])
    _fill(image, place + chimney @ axes, (70, 74, 92))


def _trees(image: Image, taken: Image, rng: np.random.Generator) -> None:
    kinds = [tree(rng) for _ in range(14)]
    woods = _noise(rng, SIDE // 8, 16) + 0.3 * _noise(rng, SIDE // 8, 60)
    for x, y in rng.uniform(60, SIDE - 60, (5200, 2)):
        wooded = woods[int(y) // 8, int(x) // 8] > 1.15
        if not wooded and rng.random() > 0.07:
            continue
        radius = int(rng.uniform(16, 40))
        rows, columns = slice(int(y) - radius, int(y) + radius), slice(int(x) - radius, int(x) + radius)
        if taken[rows, columns].any():
            continue
        crown = cv2.resize(kinds[rng.integers(len(kinds))], (2 * radius, 2 * radius), interpolation=cv2.INTER_AREA)
        alpha = crown[:, :, 3:]
        dx, dy = (SUN * radius / 26).astype(int)
        below = image[rows.start + dy : rows.stop + dy, columns.start + dx : columns.stop + dx]
        below[:] = below * (1 - 0.5 * alpha)
        region = image[rows, columns]
        region[:] = region * (1 - alpha) + crown[:, :, :3] * alpha


def tree(rng: np.random.Generator) -> NDArray[np.float32]:
    """Return a crown ``(96, 96, 4)``: BGR (0..255) and alpha (0..1), lit from where the sun stands."""
    side, crown = 96, np.zeros((96, 96, 4), np.float32)
    base = np.array([44, 88, 66]) * rng.uniform(0.75, 1.15) + rng.uniform(-8, 12, 3)
    for step in range(70):
        # from the ground up: the blobs on top are the brightest
        height = step / 70
        reach = 34 * (1 - 0.55 * height) * np.sqrt(rng.random())
        angle = rng.uniform(0, 2 * np.pi)
        lift = -SUN / np.linalg.norm(SUN) * 7 * height
        centre = np.array([np.cos(angle), np.sin(angle)]) * reach + side / 2 + lift
        colour = base * (0.55 + 0.75 * height) * rng.uniform(0.88, 1.12)
        x, y = np.rint(centre * 16).astype(int)
        cv2.circle(crown, (int(x), int(y)), int(rng.uniform(5, 11) * 16), (*colour, 1.0), -1, cv2.LINE_8, 4)
    return np.asarray(cv2.GaussianBlur(crown, (0, 0), 1.0), np.float32)


def _grained(image: Image, rng: np.random.Generator) -> Image:
    tile = rng.normal(128, 5, (SIDE // 4, SIDE // 4)).astype(np.uint8)
    grain = cv2.cvtColor(np.tile(cv2.GaussianBlur(tile, (0, 0), 0.7), (4, 4)), cv2.COLOR_GRAY2BGR)
    return np.asarray(cv2.addWeighted(image, 1.0, grain, 1.6, -128 * 1.6), np.uint8)


def _band(road: Road, span: slice, width: float) -> Points:
    """The outline of a stretch of road, square at its ends."""
    return np.concatenate([road.beside(-width / 2)[span], road.beside(width / 2)[span][::-1]])


def _stroke(image: Image, points: Points, colour: tuple[float, ...], width: float) -> None:
    line = np.rint(points[:: 1 if len(points) < 20 else 6] * 16).astype(np.int32)
    cv2.polylines(image, [line], False, colour, max(1, round(width)), cv2.LINE_AA, 4)


def _dashes(image: Image, points: Points, dash: int, gap: int) -> None:
    for start in range(0, len(points) - dash, dash + gap):
        _stroke(image, points[start : start + dash], _WHITE, 3)


def _fill(image: Image, points: Points, colour: tuple[float, ...]) -> None:
    cv2.fillPoly(image, [np.rint(points * 16).astype(np.int32)], colour, cv2.LINE_AA, 4)


def _darken(image: Image, points: Points, factor: float) -> None:
    x, y, w, h = cv2.boundingRect(np.rint(points).astype(np.int32))
    x, y = max(x, 0), max(y, 0)
    region = image[y : y + h, x : x + w]
    mask = np.zeros(region.shape[:2], np.uint8)
    _fill(mask, points - (x, y), (255, 255, 255))
    region[:] = region * (1 - (1 - factor) * (mask / 255.0))[:, :, None]
