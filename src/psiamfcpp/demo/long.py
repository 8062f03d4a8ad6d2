"""Long rendered clips in which the target leaves, is hidden and comes back: a test bed for what trackers do after loss.

The ride is the demo's. Trees hang over the target's lane, more cars look like it, and the camera looks away, jumps,
swings, freezes or goes dark.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.demo import vehicles
from psiamfcpp.demo.clip import DemoFrame, Vehicle, camera, compose, film, traffic
from psiamfcpp.demo.ground import build, tree
from psiamfcpp.demo.vehicles import Affine
from psiamfcpp.errors import UserError

Shift = NDArray[np.float64]
"""``(frames, 3)``: how far the camera's view is off, in widths and heights of the frame, and its zoom's logarithm"""
_Event = Callable[[Shift, int, np.random.Generator], None]

# Share of the other cars that get the target's colour.
_TWINS = 0.08
_TREES, _CROWN = 4, (70.0, 150.0)
"""trees over the target's lane, and the range of their widths in ground pixels"""
_FIRST, _SPACING = 60, (70, 110)
"""frames before the first event, and from one to the next"""


def render_long(seed: int = 0, frames: int = 600, size: tuple[int, int] = (640, 360)) -> Iterator[DemoFrame]:
    """Render a long clip frame by frame; the same arguments give the same frames.

    Args:
        seed: 0 or above; chooses the ride and what happens in it.
        frames: how many frames, at 30 a second.
        size: ``(width, height)`` in pixels.

    Returns:
        An iterator that holds one frame at a time. In a frame without the target `DemoFrame.visible` is false.

    Raises:
        UserError: a negative seed, or too few frames for one event.
    """
    if seed < 0 or frames < 2 * _FIRST:
        raise UserError(f"no long clip of seed {seed} and {frames} frames: give a seed from 0 and {2 * _FIRST} frames")
    return _render(seed, frames, size)


def _render(seed: int, frames: int, size: tuple[int, int]) -> Iterator[DemoFrame]:
    rng = np.random.default_rng([seed, 1])
    land = build(rng)
    target, others = traffic(land, rng)
    others = [dataclasses.replace(v, sprite=target.sprite) if rng.random() < _TWINS else v for v in others]
    views, shown = _views(camera(target, frames, size, rng), size, rng)
    trees = _trees(target, rng)
    last = None
    for frame, view, how in zip(film(land, target, others, views, size, rng), views, shown, strict=True):
        hidden = False
        for crown, place, centre, reach in trees:
            vehicles.stamp(frame.image, crown, compose(view, place), None)
            x, y, w, h = frame.box
            seen = view @ (*centre, 1)
            hidden |= bool(np.hypot(x + w / 2 - seen[0], y + h / 2 - seen[1]) < reach * np.hypot(*view[0, :2]))
        last = last if how == "frozen" and last else _judged(frame, hidden, size)
        yield _dark(frame) if how == "dark" else last


def _judged(frame: DemoFrame, hidden: bool, size: tuple[int, int]) -> DemoFrame:
    """Return the frame with whether the target is in sight: not hidden, its middle within the frame."""
    x, y, w, h = frame.box
    inside = 0 <= x + w / 2 < size[0] and 0 <= y + h / 2 < size[1]
    return dataclasses.replace(frame, visible=frame.visible and inside and not hidden)


def _dark(frame: DemoFrame) -> DemoFrame:
    return dataclasses.replace(frame, image=np.full_like(frame.image, 12), visible=False)


def _views(views: list[Affine], size: tuple[int, int], rng: np.random.Generator) -> tuple[list[Affine], list[str]]:
    """Return the views with the events in them, and for each frame whether it is shown, frozen or dark."""
    frames = len(views)
    shift, shown = np.zeros((frames, 3)), ["shown"] * frames
    kinds: list[_Event] = []
    start = _FIRST
    while start < frames - _FIRST:
        kinds = kinds or [_EVENTS[i] for i in rng.permutation(len(_EVENTS))]
        if rng.random() < 0.15:
            kind, length = rng.choice(["frozen", "dark"]), int(rng.integers(5, 40))
            shown[start : start + length] = [str(kind)] * length
        else:
            kinds.pop()(shift, start, rng)
        start += int(rng.integers(*_SPACING))
    moved = []
    for view, (x, y, zoom) in zip(views, shift, strict=True):
        scale, (width, height) = np.exp(zoom), size
        off = np.array([x * width + (1 - scale) * width / 2, y * height + (1 - scale) * height / 2])
        moved.append(compose(np.array([[scale, 0, off[0]], [0, scale, off[1]]]), view))
    return moved, shown[:frames]


def _away(shift: Shift, start: int, rng: np.random.Generator) -> None:
    """Look away until the target is out of the frame, and back."""
    ease, hold = int(rng.integers(12, 30)), int(rng.integers(15, 45))
    course = np.concatenate([_eased(ease), np.ones(hold), _eased(ease)[::-1]])
    _add(shift, start, course[:, None] * (*_direction(rng), 0))


def _away_and_cut(shift: Shift, start: int, rng: np.random.Generator) -> None:
    """Look away, and be back at once, the target somewhere else in the frame."""
    course = np.concatenate([_eased(20), np.ones(int(rng.integers(10, 40)))])
    _add(shift, start, course[:, None] * (*_direction(rng), 0))
    _cut(shift, start + len(course), rng)


def _cut(shift: Shift, start: int, rng: np.random.Generator) -> None:
    """Jump to another view; the target stays in the frame."""
    new = np.array([*rng.uniform(-0.18, 0.18, 2), rng.uniform(-0.2, 0.2)])
    shift[start:] = new


def _swing(shift: Shift, start: int, rng: np.random.Generator) -> None:
    """Swing quickly, the target staying in the frame, and slowly back."""
    course = np.concatenate([_eased(int(rng.integers(4, 9))), _eased(40)[::-1]])
    _add(shift, start, course[:, None] * (*rng.choice([-1, 1], 2) * rng.uniform(0.12, 0.25, 2), 0))


_EVENTS: tuple[_Event, ...] = (_away, _away, _away_and_cut, _cut, _swing)


def _direction(rng: np.random.Generator) -> tuple[float, float]:
    """Return a shift that takes the target out of the frame, whichever way it stands in it."""
    angle = rng.uniform(0, 2 * np.pi)
    return 1.3 * float(np.cos(angle)), 1.3 * float(np.sin(angle))


def _eased(frames: int) -> NDArray[np.float64]:
    return (1 - np.cos(np.linspace(0, np.pi, frames))) / 2


def _add(shift: Shift, start: int, course: NDArray[np.float64]) -> None:
    part = shift[start : start + len(course)]
    part += course[: len(part)]


def _trees(
    target: Vehicle, rng: np.random.Generator
) -> list[tuple[NDArray[np.float32], Affine, tuple[float, float], float]]:
    """Return crowns over the target's lane: pixels, placement on the land, centre, radius within which they hide."""
    found = []
    for share in np.linspace(0.12, 0.9, _TREES) + rng.uniform(-0.06, 0.06, _TREES):
        x, y, _ = target.pose(float(share))
        width = rng.uniform(*_CROWN)
        crown = tree(rng)
        crown[..., :3] *= crown[..., 3:]
        scale = width / 68  # of its 96 pixels a crown fills about 68
        place = np.array([[scale, 0, x - 48 * scale], [0, scale, y - 48 * scale]])
        found.append((crown, place, (x, y), 0.42 * width))
    return found
