"""The search for a target that is out of sight: where to look next, and when what was found is the target.

One place is looked at a frame, beside what the tracker follows: the one where the target most probably is. The chance
is highest where the target is expected, which stays put in the world and moves on as the target did. It spreads with
time, is raised where something moves by itself, and is reduced where was looked a short time ago. What is found becomes
a rival of what is followed, is itself followed, and must prove itself in several frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from psiamfcpp.spec import Calibration
from psiamfcpp.trackers.siamfcpp.camera import Motion, moved
from psiamfcpp.trackers.siamfcpp.confidence import log_odds
from psiamfcpp.trackers.siamfcpp.procedure import Target

Movers = Callable[[float], list[tuple[float, float]]]
"""`Camera.movers`"""

# A lost target keeps its velocity for 30 frames (1 s).
_COAST_FRAMES = 30
# Sizes in which the target is looked for in turn, over that when it was last seen: a region laid for a larger target
# shows more, and in most looks the target is still found with `unsure_below`.
_SIZES = (1.3, 1.0, 1.7)
# Standard deviation of the expected place, in sides of the target: at first, and what each frame adds.
_SPREAD, _SPREADS_BY = 0.5, 0.15
# Chances against that at the expected place: of any other place, and of what moves by itself.
_ANYWHERE, _MOVING = 0.02, 0.3
# Share of the chance that is left where was just looked, and what comes back of the rest in each frame.
_LEFT, _COMES_BACK = 0.1, 0.1
# Chances are kept for cells of half a look's reach, but for this many a row at most.
_CELLS = 64
# A look counts for this share of its reach, since targets at the rim of a search region are found less well.
_WITHIN = 0.9
# Frames in a row in which a rival must lead, and frames after which one that does not is given up.
_PROOF, _PATIENCE = 5, 12
# Their mean confidence, as a share of the way from `unsure_below` to `regain_above`.
_LEVEL = 0.8
# In the last of them the odds for the rival must be this many times those for what is followed: a target that was
# hardly visible and comes back is not left for something similar.
_LEADS_BY = math.log(6)


@dataclass
class Rival:
    """Something that may be the target, beside what is followed."""

    target: Target
    values: list[float] = field(default_factory=list)
    """the confidence in it, frame by frame"""
    leads: list[float] = field(default_factory=list)
    """log-odds for it, less those for what is followed"""


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
        self._velocity, self._age, self._looks = velocity, 0, 0
        self._cell = 0.0
        self._left: NDArray[np.float32] | None = None

    @property
    def turn(self) -> int:
        """Number of the look: those of the target are compared in turn, to find a rival and to prove it."""
        return len(self.rival.values) if self.rival else self._looks // len(_SIZES)

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
        if self._left is not None:
            in_cells = motion.copy()
            in_cells[:, 2] = (motion @ (self._cell / 2, self._cell / 2, 1.0)) / self._cell - 0.5
            size = self._left.shape[::-1]
            left = cv2.warpAffine(self._left, in_cells, size, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0)
            self._left = np.asarray(1 - (1 - left) * (1 - _COMES_BACK), np.float32)
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
        size = _SIZES[self._looks % len(_SIZES)]
        self._looks += 1
        t, (height, width) = self.place, frame_shape[:2]
        if self._left is None:
            self._cell = max(reach / 2, width / _CELLS)
            self._left = np.ones((max(1, round(height / self._cell)), max(1, round(width / self._cell))), np.float32)
        side = math.sqrt(t.w * t.h)
        spread = side * (_SPREAD + _SPREADS_BY * self._age)
        chances = _ANYWHERE + self._bump(t.cx, t.cy, spread)
        for x, y in movers(side):
            chances = chances + _MOVING * self._bump(x, y, side)
        # Cells that a look at a cell covers, an odd number.
        covered = int(2 * _WITHIN * reach * size / self._cell) | 1
        total = cv2.blur(self._left * chances, (covered, covered), borderType=cv2.BORDER_CONSTANT)
        row, column = divmod(int(total.argmax()), total.shape[1])
        top, left = max(row - covered // 2, 0), max(column - covered // 2, 0)
        self._left[top : row + covered // 2 + 1, left : column + covered // 2 + 1] *= _LEFT
        return Target((column + 0.5) * self._cell, (row + 0.5) * self._cell, t.w * size, t.h * size)

    def _bump(self, x: float, y: float, spread: float) -> NDArray[np.float32]:
        """Return a Gaussian of height 1 about a place of the frame, one value for each cell."""
        assert self._left is not None
        rows, columns = ((np.arange(n) + 0.5) * self._cell for n in self._left.shape)
        squares = (columns - x) ** 2 + ((rows - y) ** 2)[:, None]
        return np.asarray(np.exp(-squares / (2 * spread**2)), np.float32)

    def judge(self, found: Target, value: float, followed: float, limits: Calibration) -> bool:
        """Take what was found where `aim` said; whether it has proved to be the target.

        Args:
            found: what was found.
            value: the confidence in it.
            followed: the confidence in what is followed.
            limits: of the confidence.
        """
        if self.rival is None:
            if value < limits.unsure_below:
                return False
            self.rival = Rival(found)
        rival = self.rival
        rival.target = found
        rival.values.append(value)
        rival.leads.append(log_odds(value) - log_odds(followed))
        if value < limits.unsure_below or len(rival.values) > _PATIENCE:
            self.rival = None
            return False
        values, leads = rival.values[-_PROOF:], rival.leads[-_PROOF:]
        proved = len(values) == _PROOF and sum(values) >= _PROOF * proof_level(limits)
        return proved and sum(leads) > 0 and leads[-1] >= _LEADS_BY


def proof_level(limits: Calibration) -> float:
    """Return the confidence, on average, at which something proves to be the target."""
    return limits.unsure_below + _LEVEL * (limits.regain_above - limits.unsure_below)


def lies_in(found: Target, box: Target) -> bool:
    """Return whether the centre of what was found is inside a box."""
    return abs(found.cx - box.cx) < box.w / 2 and abs(found.cy - box.cy) < box.h / 2
