"""A made clip: a drone follows a car over roads, past others of its kind and below a bridge.

Everything is drawn from geometry, so that the true box of every frame is known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from psiamfcpp.demo import vehicles
from psiamfcpp.demo.ground import LANE, SUN, Land, Road, build
from psiamfcpp.demo.vehicles import Affine, Colour, Sprite
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image

Pose = tuple[float, float, float]
"""place and heading ``(x, y, radians)`` on the land"""
_Move = Callable[[float], Pose]
"""the pose at a share of the clip, 0 to 1"""

TARGET_COLOURS: tuple[Colour, ...] = ((40, 36, 205), (200, 104, 24), (20, 150, 235))
"""BGR; the seed chooses one"""

_OTHERS: tuple[Colour, ...] = ((226, 228, 228), (150, 152, 152), (58, 54, 52), (120, 66, 40), (92, 108, 96))
_TRAVEL = 2150.0
"""ground pixels that the target drives in the clip"""
_UNDER_BRIDGE = 0.47
"""share of the clip after which it is below the middle of the bridge"""
_ZOOM, _ZOOM_SPREAD = 0.89, 0.31


@dataclass(frozen=True, slots=True)
class DemoFrame:
    """A frame with its truth."""

    image: Image
    """``(H, W, 3)`` uint8 BGR"""
    box: Box
    """around the target's body, ``(x, y, w, h)`` in pixels, also where it is hidden"""
    visible: bool
    """at least half of the target is in sight"""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """What drives through the clip."""

    sprite: Sprite
    pose: _Move
    below: bool
    """drives below the bridge, not over it"""


def render(seed: int = 0, frames: int = 300, size: tuple[int, int] = (1280, 720)) -> Iterator[DemoFrame]:
    """Render the clip frame by frame; the same arguments give the same frames.

    However many frames it has, the clip shows the whole ride. At 1280x720 the target is about 35 to 70 pixels
    long; it grows and shrinks with the frame.

    Args:
        seed: 0 or above; chooses the land, the traffic, the target's colour and the camera's path.
        frames: how many frames, at 30 a second.
        size: ``(width, height)`` in pixels.

    Returns:
        An iterator that holds one frame at a time.

    Raises:
        UserError: a negative seed, fewer than two frames, or a side below 64 pixels.
    """
    if seed < 0:
        raise UserError(f"demo seed {seed} is negative: give 0 or above")
    if frames < 2:
        raise UserError(f"a demo of {frames} frames is too short: give at least 2")
    if min(size) < 64:
        raise UserError(f"a demo of {size[0]}x{size[1]} is too small: give at least 64 pixels a side")
    return _render(seed, frames, size)


def _render(seed: int, frames: int, size: tuple[int, int]) -> Iterator[DemoFrame]:
    rng = np.random.default_rng(seed)
    land = build(rng)
    target, others = traffic(land, rng)
    yield from film(land, target, others, camera(target, frames, size, rng), size, rng)


def film(
    land: Land,
    target: Vehicle,
    others: list[Vehicle],
    views: list[Affine],
    size: tuple[int, int],
    rng: np.random.Generator,
) -> Iterator[DemoFrame]:
    """Draw a ride frame by frame.

    Args:
        land: what the camera flies over.
        target: the vehicle whose box is the truth.
        others: all other vehicles.
        views: from the land to each frame, ``(2, 3)``.
        size: ``(width, height)`` in pixels.
        rng: of the noise.

    Returns:
        An iterator that holds one frame at a time.
    """
    noise = rng.normal(128, 3.2, (size[1] + 64, size[0] + 64, 3)).astype(np.uint8)
    for share, view in zip(np.linspace(0, 1, len(views)), views, strict=True):
        ground = cv2.warpAffine(land.texture, view, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        image = np.asarray(ground, np.uint8)
        in_sight = 1.0
        for vehicle in sorted([target, *others], key=lambda v: not v.below):
            open_share = _show(image, vehicle, share, view, land)
            if vehicle is target:
                in_sight = open_share
        soft = cv2.GaussianBlur(image, (3, 3), 0.55)
        x, y = rng.integers(0, 64, 2)
        grainy = cv2.addWeighted(soft, 1.0, noise[y : y + size[1], x : x + size[0]], 1.0, -128)
        yield DemoFrame(np.asarray(grainy, np.uint8), _box(target, share, view), in_sight >= 0.5)


def traffic(land: Land, rng: np.random.Generator) -> tuple[Vehicle, list[Vehicle]]:
    """Return the target, and all the others."""
    colour = TARGET_COLOURS[rng.integers(len(TARGET_COLOURS))]
    start = land.main.nearest(land.bridge) - _UNDER_BRIDGE * _TRAVEL

    def beside(gap: float, gain: float, lane: float) -> _Move:
        """Keep to the target's pace, ``gap`` ahead of it at first and ``gain`` further in the end."""

        def place(share: float) -> float:
            # evenly paced at the bridge, slower where the road turns
            own = share + 0.02 * np.sin(2 * np.pi * (share - _UNDER_BRIDGE))
            return start + _TRAVEL * own + gap + gain * share

        return _drive(land.main, place, lane, False)

    target = Vehicle(vehicles.car(colour), beside(0, 0, 1.5), True)
    others = [
        Vehicle(vehicles.truck((150, 90, 40)), beside(320, 0, 1.5), True),
        Vehicle(vehicles.car(_any(rng)), beside(-190, 0, 1.5), True),
        Vehicle(vehicles.car(_OTHERS[0]), beside(-330, 1250, 0.5), True),
        Vehicle(vehicles.van(_OTHERS[0]), beside(-760, 900, 0.5), True),
    ]
    others += _oncoming(land.main, start + 0.78 * _TRAVEL, colour, rng)
    others += _crossing(land, rng)
    others += [Vehicle(vehicles.car(_any(rng)), _stay(yard), False) for yard in land.yards]
    return target, others


def _oncoming(road: Road, meet: float, twin: Colour, rng: np.random.Generator) -> list[Vehicle]:
    """Two lanes towards the target, with one car that looks just like it and passes it at ``meet``."""
    found = []
    for lane, pace in ((-0.5, 1900.0), (-1.5, 1500.0)):
        for number in range(-9, 10):
            first = meet + 0.78 * pace + 330 * number
            if lane == -0.5 and number == 0:
                sprite = vehicles.car(twin)
            else:
                first += rng.uniform(-90, 90)
                vans = rng.random() < 0.25
                sprite = vehicles.van(_OTHERS[rng.integers(2)]) if vans else vehicles.car(_any(rng))
            found.append(Vehicle(sprite, _drive(road, _steady(first, -pace), lane, True), True))
    return found


def _crossing(land: Land, rng: np.random.Generator) -> list[Vehicle]:
    """Two lanes over the bridge."""
    found = []
    middle = land.crossing.nearest(land.bridge)
    for lane, pace in ((0.5, 1250.0), (-0.5, -1250.0)):
        for number in range(-5, 6):
            place = _steady(middle + 420 * number + rng.uniform(-130, 130) - pace / 2, pace)
            sprite = vehicles.car(_any(rng))
            found.append(Vehicle(sprite, _drive(land.crossing, place, lane, pace < 0), False))
    return found


def _any(rng: np.random.Generator) -> Colour:
    return _OTHERS[rng.integers(len(_OTHERS))]


def _steady(start: float, travel: float) -> Callable[[float], float]:
    return lambda share: start + travel * share


def _stay(pose: Pose) -> _Move:
    return lambda share: pose


def _drive(road: Road, place: Callable[[float], float], lane: float, back: bool) -> _Move:
    """Along a road, ``lane`` lanes to the right of its middle, against its direction if ``back``."""

    def pose(share: float) -> Pose:
        x, y, heading = road.at(place(share), lane * LANE)
        return x, y, heading + np.pi * back

    return pose


def camera(target: Vehicle, frames: int, size: tuple[int, int], rng: np.random.Generator) -> list[Affine]:
    """Return the views from the land to each frame, ``(2, 3)``: the target wanders, the camera turns and shakes."""
    width, height = size
    scale = min(width / 1280, height / 720)
    phase = rng.uniform(0, 2 * np.pi, 6)
    turn, swing = rng.uniform(-0.5, 0.5), rng.choice([-1, 1]) * rng.uniform(0.45, 0.65)
    views = []
    for number, share in enumerate(np.linspace(0, 1, frames)):
        x, y, _ = target.pose(share)
        shake = [np.sin(number * rate + p) for rate, p in zip((0.9, 1.37, 0.61, 0.43, 1.13), phase, strict=False)]
        zoom = scale * _ZOOM * np.exp(_ZOOM_SPREAD * np.cos(2 * np.pi * (1.1 * share + 0.05)))
        angle = turn + swing * np.sin(np.pi * (share - 0.3)) + 0.0012 * shake[2]
        cos, sin = zoom * np.cos(angle), zoom * np.sin(angle)
        to_x = width * (0.5 + 0.2 * np.sin(2 * np.pi * 0.8 * share + phase[5])) + scale * (shake[0] + 0.7 * shake[3])
        to_y = height * (0.5 + 0.16 * np.sin(2 * np.pi * 1.3 * share + phase[4])) + scale * (shake[1] + 0.7 * shake[4])
        views.append(np.array([[cos, -sin, to_x - cos * x + sin * y], [sin, cos, to_y - sin * x - cos * y]]))
    return views


def _show(image: Image, vehicle: Vehicle, share: float, view: Affine, land: Land) -> float:
    """Draw a vehicle with its shadow, in place; how much of it is in sight, 0 to 1."""
    x, y, heading = vehicle.pose(share)
    seen = view @ (x, y, 1)
    if not (-100 < seen[0] < image.shape[1] + 100 and -100 < seen[1] < image.shape[0] + 100):
        return 1.0
    cover = None
    if vehicle.below and float(np.hypot(*(land.bridge - (x, y)))) < 330:
        shift = np.array([[1, 0, land.cover_origin[0]], [0, 1, land.cover_origin[1]]])
        cover = (land.cover, compose(view, shift))
    body = compose(_rigid(x, y, heading), vehicle.sprite.placement)
    dark = compose(_rigid(x + SUN[0], y + SUN[1], heading), vehicle.sprite.placement)
    vehicles.stamp(image, vehicle.sprite.shadow, compose(view, dark), cover)
    return vehicles.stamp(image, vehicle.sprite.pixels, compose(view, body), cover)


def _box(vehicle: Vehicle, share: float, view: Affine) -> Box:
    outline = vehicle.sprite.outline
    points = np.concatenate([outline, np.ones((len(outline), 1))], axis=1)
    to_view = compose(view, _rigid(*vehicle.pose(share)))
    low, high = (f(points @ to_view.T, axis=0) for f in (np.min, np.max))
    # an edge at 9.5 is where pixel 10 begins
    return (float(low[0] + 0.5), float(low[1] + 0.5), float(high[0] - low[0]), float(high[1] - low[1]))


def _rigid(x: float, y: float, angle: float) -> Affine:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, x], [sin, cos, y]])


def compose(outer: Affine, inner: Affine) -> Affine:
    """Return the transform that applies ``inner``, then ``outer``."""
    return outer @ np.concatenate([inner, [[0.0, 0.0, 1.0]]])
