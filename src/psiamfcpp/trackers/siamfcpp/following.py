"""The state of one followed target: where to search next, and what the network's answer means for the target.

No engine is held here: `Following.aim` says what to search, and whoever owns an engine hands the answer to
`Following.conclude`. So one engine can serve any number of targets.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.geometry import Box, Image, centre, check_box, check_frame, from_centre
from psiamfcpp.models.arch import opened
from psiamfcpp.runtime import Engine
from psiamfcpp.spec import Calibration, ModelSpec
from psiamfcpp.trackers.contract import State, Track
from psiamfcpp.trackers.siamfcpp.confidence import StateMachine, confidence
from psiamfcpp.trackers.siamfcpp.contest import Contest
from psiamfcpp.trackers.siamfcpp.procedure import (
    Estimate,
    FloatMap,
    Procedure,
    Target,
    contrast,
    hidden,
)

Search = Callable[[Image, Any], tuple[FloatMap, FloatMap]]
"""`Engine.search`"""

# Running means over about 10 frames. Just before a target disappears it is partly occluded and its size and speed are
# underestimated; a mean is not. A lost target keeps its velocity for 30 frames (1 s).
_MEMORY_RATE, _COAST_FRAMES = 0.1, 30
# After this many frames without the target, what is re-acquired away from its expected place may be another object.
_UNSEEN = 3
# A frame whose grey levels, at one pixel in 16 by 16, spread by less than this shows nothing but noise.
_BLANK_SPREAD, _SAMPLED = 1.5, 16
# The search region of a lost target is this much larger than that of a followed one.
_LOST_REACH = 1.3


@dataclass(frozen=True, slots=True)
class Look:
    """One search region that the network still has to judge."""

    around: Target
    """centre and size that the region is laid about"""
    region: Image
    """search crop ``(S, S, 3)`` uint8, BGR"""
    kernels: Any
    """of the target's template, as the engine gave them"""


class Following:
    """One followed target.

    Args:
        engine: computes the kernels of the template; it is not kept.
        spec: the model's description; its procedure, constants and calibration are used.
        plain: follow the published procedure, without states and re-detection.
        frame: ``(H, W, 3)`` uint8, BGR.
        box: ``(x, y, w, h)`` of the target, pixels, 0-based.

    Raises:
        UserError: the frame is no such image, or the box cannot be tracked in it.
    """

    def __init__(self, engine: Engine, spec: ModelSpec, plain: bool, frame: Image, box: ArrayLike):
        check_frame(frame)
        x, y, w, h = check_box(box, frame.shape)
        cx, cy = (float(v) for v in centre((x, y, w, h)))
        self._spec, self._limits = spec, spec.calibration or Calibration()
        self._plain = plain or spec.calibration is None
        self._plain_state: State | None = "tracking" if spec.calibration else None
        self._procedure: Procedure = opened(spec.arch.procedure)
        self.first = Track((x, y, w, h), 1.0, self._plain_state)
        cells = spec.arch.score_size(spec.search_size, spec.template_size)
        self._window = self._procedure.window(cells)
        # Half the width of the region in which targets can be found, in pixels of the search crop.
        self._reach = cells * spec.arch.stride / 2
        self._buffer = np.empty((spec.search_size, spec.search_size, 3), np.uint8)
        self._target = self._seen = Target(cx, cy, w, h)
        self._smallest = min(self._procedure.smallest, w, h)
        self._fill = self._procedure.fill(frame)
        self._states = StateMachine(self._limits)
        self._velocity = (0.0, 0.0)
        self._unseen_for = self._lost_for = 0
        self._contest: Contest | None = None
        size = spec.template_size
        self._kernels = engine.template(self._procedure.crop(frame, self._target, size, size, self._fill, None))

    def aim(self, frame: Image, out: Image | None = None) -> Look:
        """Return what to search in the next frame; the state stays as it is.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.
            out: buffer ``(S, S, 3)`` for the region; by default one that the next call overwrites.

        Raises:
            UserError: the frame is no such image.
        """
        check_frame(frame)
        return self.look_at(frame, self._where_to_look(frame.shape), out)

    def update(self, frame: Image, search: Search) -> Track:
        """Find the target in the next frame; takes a frame ``(H, W, 3)`` uint8, BGR, and the engine's search."""
        look = self.aim(frame)
        return self.conclude(frame, look, *search(look.region, look.kernels), search)

    def look_at(self, frame: Image, around: Target, out: Image | None = None) -> Look:
        """Return the search region about a given place; the state stays as it is."""
        spec = self._spec
        buffer = self._buffer if out is None else out
        region = self._procedure.crop(frame, around, spec.search_size, spec.template_size, self._fill, buffer)
        return Look(around, region, self._kernels)

    def read(self, around: Target, scores: FloatMap, boxes: FloatMap) -> tuple[Estimate, float]:
        """Return the estimate of a searched region and its contrast (see `procedure.contrast`)."""
        found = self._procedure.estimate(scores, boxes, around, self._spec, self._window)
        return found, contrast(scores, boxes, found.cell)

    def conclude(self, frame: Image, look: Look, scores: FloatMap, boxes: FloatMap, search: Search) -> Track:
        """Update the state by the network's answer, and return where the target is.

        Args:
            frame: the frame that was searched.
            look: what `aim` gave for it.
            scores: ``(N, N)``.
            boxes: ``(N, N, 4)`` as x0, y0, x1, y1 in pixels of the region.
            search: the engine's search, for a second region while a re-detection is verified.
        """
        if not self._plain and _blank(frame):
            # No evidence: the target is where it was, and is searched for there first when the video is back.
            return Track(self._box(), 0.0, self._states.step(0.0))
        found, apart = self.read(look.around, scores, boxes)
        if self._plain:
            self._target = self._moved(self._target, found, self._rate(found), frame)
            return Track(self._box(), found.score, self._plain_state)
        value = confidence(found.score, apart, self._limits)
        return self._judge(frame, look.around, found, value, search)

    def _judge(self, frame: Image, around: Target, found: Estimate, value: float, search: Search) -> Track:
        """Move as far as the confidence allows, and return the target with its state."""
        was_lost = self._states.state == "lost"
        guess, gone_on = self._target, self._gone_on(self._target, frame)
        expected = _lies_in(found.target, self._seen if was_lost else gone_on)
        state = self._states.step(value, elsewhere=not expected)
        if state == "tracking":
            last_seen = self._gone_on(self._seen, frame)
            if self._unseen_for >= _UNSEEN and not _lies_in(found.target, last_seen):
                self._contest = Contest(last_seen, self._velocity)
            self._target = self._moved(around, found, self._rate(found), frame)
            self._see()
            value = self._contested(frame, found.score, value, search)
            return Track(self._box(), value, state)
        self._unseen_for += 1
        self._seen = self._gone_on(self._seen, frame)
        self._lost_for = self._lost_for + 1 if state == "lost" else 0
        if state == "lost":
            self._contest = None
        if state == "unsure" and value < self._limits.lost_below and not expected:
            self._target = gone_on
        elif around == guess:
            self._target = self._moved(guess, found, 0.0, frame)
        return Track(self._box(), value, state)

    def _contested(self, frame: Image, score: float, value: float, search: Search) -> float:
        """Search the expected place as well, while a re-detection is verified, and switch to what wins there.

        Args:
            frame: the frame that is searched.
            score: of what is followed.
            value: the confidence in it.
            search: the engine's search.

        Returns:
            The confidence in what is followed from now on.
        """
        contest, limits, spec = self._contest, self._limits, self._spec
        if contest is None:
            return value
        around = contest.place
        look = self.look_at(frame, around)
        scores, boxes = search(look.region, look.kernels)
        scale, middle = self._procedure.zoom(around, spec), self._procedure.middle(spec.search_size)
        scores = hidden(scores, boxes, around, self._target, scale, middle)
        found, apart = self.read(around, scores, boxes)
        rival = confidence(found.score, apart, limits)
        won = contest.judge(found.target, rival >= limits.regain_above, found.score - score)
        if won:
            self._target = self._seen = dataclasses.replace(around, cx=found.target.cx, cy=found.target.cy)
            self._velocity = contest.velocity
        if won or contest.looks_left == 0:
            self._contest = None
        return rival if won else value

    def _where_to_look(self, frame_shape: tuple[int, ...]) -> Target:
        """Return the target's place; while lost also, in turn, its last seen place and a growing region about it."""
        if self._lost_for % 2 == 0:
            return self._target
        t = dataclasses.replace(self._seen, w=self._seen.w * _LOST_REACH, h=self._seen.h * _LOST_REACH)
        column, row = spiral(self._lost_for // 2 + 1)
        step = self._reach / self._procedure.zoom(t, self._spec)
        height, width = frame_shape[:2]
        cx, cy = t.cx + column * step, t.cy + row * step
        if not (0 <= cx < width and 0 <= cy < height):
            # Rather than search outside the frame, search the last seen place again.
            return t
        return Target(cx, cy, t.w, t.h)

    def _moved(self, around: Target, found: Estimate, rate: float, frame: Image) -> Target:
        return self._procedure.move(around, found, rate, frame.shape, self._smallest)

    def _rate(self, found: Estimate) -> float:
        return self._procedure.rate(found, self._spec.constants)

    def _see(self) -> None:
        """Note where the target was seen, and how fast it moves."""
        t, before = self._target, self._seen
        if self._unseen_for == 0:
            vx, vy = self._velocity
            dx, dy = t.cx - before.cx, t.cy - before.cy
            self._velocity = (vx + _MEMORY_RATE * (dx - vx), vy + _MEMORY_RATE * (dy - vy))
        w, h = (b + _MEMORY_RATE * (a - b) for a, b in ((t.w, before.w), (t.h, before.h)))
        self._seen, self._unseen_for, self._lost_for = Target(t.cx, t.cy, w, h), 0, 0

    def _gone_on(self, t: Target, frame: Image) -> Target:
        """Return a target one frame later, at its last known velocity: most targets disappear behind an obstacle."""
        if self._unseen_for > _COAST_FRAMES:
            return t
        (vx, vy), (height, width) = self._velocity, frame.shape[:2]
        return Target(min(max(t.cx + vx, 0.0), width - 1.0), min(max(t.cy + vy, 0.0), height - 1.0), t.w, t.h)

    def _box(self) -> Box:
        return from_centre(self._target.cx, self._target.cy, self._target.w, self._target.h)


def _lies_in(found: Target, box: Target) -> bool:
    return abs(found.cx - box.cx) < box.w / 2 and abs(found.cy - box.cy) < box.h / 2


def _blank(frame: Image) -> bool:
    """Return whether a frame shows nothing: a lost video signal, a covered lens."""
    return bool(frame[::_SAMPLED, ::_SAMPLED].std(axis=(0, 1)).max() < _BLANK_SPREAD)


def spiral(n: int) -> tuple[int, int]:
    """Return column and row of the square to search in the ``n``-th search about the place of the loss (from 1).

    Every other search is at the place of the loss itself, where most targets reappear. Those between walk rings of
    squares about it; a ring is entered only when the one inside it is complete. After four rings the walk begins anew.
    """
    if n % 2:
        return 0, 0
    k = (n // 2 - 1) % sum(8 * r for r in range(1, 5))
    ring = 1
    while k >= 8 * ring:
        k -= 8 * ring
        ring += 1
    side, along = divmod(k, 2 * ring)
    return [(along - ring, -ring), (ring, along - ring), (ring - along, ring), (-ring, ring - along)][side]
