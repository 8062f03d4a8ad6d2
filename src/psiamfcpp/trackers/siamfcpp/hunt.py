"""The search for a target that is out of sight: where to look next, and when what was found is the target.

One place is looked at a frame, beside what the tracker follows: in turn where the target is expected, which stays put
in the world and moves on as the target did, what moves by itself, and the tiles of the whole frame, the nearest first.
What is found becomes a rival of what is followed, is itself followed, and must prove itself in several frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.spec import Calibration
from psiamfcpp.trackers.siamfcpp.camera import Motion, moved
from psiamfcpp.trackers.siamfcpp.procedure import Target

Movers = Callable[[float], list[tuple[float, float]]]
"""`Camera.movers`"""

# A lost target keeps its velocity for 30 frames (1 s).
_COAST_FRAMES = 30
# Sizes in which the frame is searched, over that of the target when it was last seen, one for each round of the tiles:
# a region laid for a larger target shows more.
_SIZES = (1.3, 1.0, 1.7)
# Tiles overlap, since targets at the rim of a search region are found less well.
_OVERLAP = 0.85
# Frames in a row in which a rival must lead, and frames after which one that does not is given up.
_PROOF, _PATIENCE = 5, 25


@dataclass
class Rival:
    """Something that may be the target, beside what is followed."""

    target: Target
    values: list[float] = field(default_factory=list)
    """the confidence in it, frame by frame"""
    leads: list[float] = field(default_factory=list)
    """its score less the score of what is followed"""


class Hunt:
    """The places to look at while a target is out of sight.

    Args:
        seen: where it was seen last, at its usual size.
        velocity: of it in the frame, pixels a frame.
    """

    def __init__(self, seen: Target, velocity: tuple[float, float]):
        self.place = seen
        """where the target is expected"""
        self.rival: Rival | None = None
        self._velocity, self._age, self._looks, self._round = velocity, 0, 0, -1
        self._tiles: NDArray[np.float64] = np.empty((0, 2))

    @property
    def turn(self) -> int:
        """Number of the look: those of the target are compared in turn, to find a rival and to prove it."""
        return len(self.rival.values) if self.rival else self._looks // 4

    def go_on(self, motion: Motion) -> None:
        """Move all places by one frame: with the camera, the target's also as it moved when it was last seen.

        Args:
            motion: of the camera.
        """
        before, t = self.place, moved(self.place, motion)
        if self._age == 1:
            # The camera moves now about as it did before: what remains of the velocity is the target's own.
            self._velocity = (self._velocity[0] - t.cx + before.cx, self._velocity[1] - t.cy + before.cy)
        vx, vy = self._velocity if self._age < _COAST_FRAMES else (0.0, 0.0)
        self.place = Target(t.cx + vx, t.cy + vy, t.w, t.h)
        self._age += 1
        self._tiles = self._tiles @ motion[:, :2].T + motion[:, 2]
        if self.rival:
            self.rival.target = moved(self.rival.target, motion)

    def aim(self, reach: float, frame_shape: tuple[int, ...], movers: Movers) -> Target:
        """Return what to look at next, as centre and size of the target that may be there.

        Args:
            reach: half the side of the part of the frame in which a look at the place finds targets, pixels.
            frame_shape: ``(height, width, ...)``.
            movers: gives places of what moves by itself, for a side in pixels.
        """
        if self.rival:
            return self.rival.target
        self._looks += 1
        t, (height, width) = self.place, frame_shape[:2]
        turn = self._looks % 4
        if turn == 1 and 0 <= t.cx < width and 0 <= t.cy < height:
            return t
        if turn == 3 and (places := movers(math.sqrt(t.w * t.h))):
            cx, cy = places[self._looks // 4 % len(places)]
            return Target(cx, cy, t.w, t.h)
        while True:
            if not len(self._tiles):
                self._round += 1
                step = 2 * _OVERLAP * reach * _SIZES[self._round % len(_SIZES)]
                self._tiles = _tiles(t, step, width, height)
            (cx, cy), self._tiles = self._tiles[0], self._tiles[1:]
            if 0 <= cx < width and 0 <= cy < height:
                size = _SIZES[self._round % len(_SIZES)]
                return Target(float(cx), float(cy), t.w * size, t.h * size)

    def judge(self, found: Target, value: float, lead: float, limits: Calibration) -> bool:
        """Take what was found where `aim` said; whether it has proved to be the target.

        Args:
            found: what was found.
            value: the confidence in it.
            lead: its score less the score of what is followed.
            limits: of the confidence.
        """
        if self.rival is None:
            if value < (limits.unsure_below if lies_in(found, self.place) else limits.regain_above):
                return False
            self.rival = Rival(found)
        rival = self.rival
        rival.target = found
        rival.values.append(value)
        rival.leads.append(lead)
        if value < limits.unsure_below or len(rival.values) > _PATIENCE:
            self.rival = None
            return False
        values, leads = rival.values[-_PROOF:], rival.leads[-_PROOF:]
        return len(values) == _PROOF and sum(values) >= _PROOF * limits.regain_above and sum(leads) > 0


def lies_in(found: Target, box: Target) -> bool:
    """Return whether the centre of what was found is inside a box."""
    return abs(found.cx - box.cx) < box.w / 2 and abs(found.cy - box.cy) < box.h / 2


def _tiles(place: Target, step: float, width: int, height: int) -> NDArray[np.float64]:
    """Return centres ``(n, 2)`` of squares that cover the frame, those nearest to a place first."""
    columns, rows = (max(1, math.ceil(side / step)) for side in (width, height))
    x = (np.arange(columns) + 0.5) * width / columns
    y = (np.arange(rows) + 0.5) * height / rows
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return centres[np.argsort(np.hypot(centres[:, 0] - place.cx, centres[:, 1] - place.cy))]
