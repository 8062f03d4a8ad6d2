"""The search for a target that is out of sight: where to look next, and when what was found is the target.

One place is looked at a frame, beside what the tracker follows: in turn where the target is expected, which stays put
in the world and moves on as the target did, and the tiles of the whole frame, the nearest first. What is found becomes
a rival of what is followed, is itself followed, and must prove itself in several frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.spec import Calibration
from psiamfcpp.trackers.siamfcpp.camera import Motion, moved
from psiamfcpp.trackers.siamfcpp.procedure import Target

# A lost target keeps its velocity for 30 frames (1 s).
_COAST_FRAMES = 30
# Sizes in which the frame is searched, over that of the target when it was last seen, one for each round of the tiles:
# a region laid for a larger target shows more.
_SIZES = (1.3, 1.0, 1.7)
# Tiles overlap, since targets at the rim of a search region are found less well.
_OVERLAP = 0.85
# A rival must give the evidence of this many looks at the limit for re-acquiring a target; after _PATIENCE looks one
# that does not is given up.
_PROOF, _PATIENCE = 5, 25


@dataclass
class Rival:
    """Something that may be the target, beside what is followed."""

    target: Target
    looks: int = 0
    evidence: float = 0.0
    """sum of the log-odds that the looks gave, no look counting for more than one at `Calibration.regain_above`"""
    lead: float = 0.0
    """sum of its scores less those of what is followed"""


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
        return self.rival.looks if self.rival else self._looks // 2

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

    def aim(self, reach: float, frame_shape: tuple[int, ...], near: bool) -> Target:
        """Return what to look at next, as centre and size of the target that may be there.

        Args:
            reach: half the side of the part of the frame in which a look at the place finds targets, pixels.
            frame_shape: ``(height, width, ...)``.
            near: only where the target is expected.
        """
        if self.rival:
            return self.rival.target
        self._looks += 1
        t, (height, width) = self.place, frame_shape[:2]
        if near or (self._looks % 2 and 0 <= t.cx < width and 0 <= t.cy < height):
            return t
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
        if value < limits.unsure_below or (self.rival and self.rival.looks == _PATIENCE):
            self.rival = None
            return False
        rival = self.rival = self.rival or Rival(found)
        enough = _log_odds(limits.regain_above)
        rival.target = found
        rival.looks += 1
        rival.evidence += min(_log_odds(value), enough)
        rival.lead += lead
        # A little less, since sums are rounded.
        return rival.looks >= _PROOF and rival.evidence >= (_PROOF - 1e-6) * enough and rival.lead > 0


def _log_odds(value: float) -> float:
    value = min(max(value, 1e-6), 1 - 1e-6)
    return math.log(value / (1 - value))


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
