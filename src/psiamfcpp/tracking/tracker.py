"""The tracker: a box on the first frame, then one box a frame."""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.crop import mean_colour, target_crop
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image, centre, check_box, context_side, from_centre
from psiamfcpp.runtime import Engine, open_engine
from psiamfcpp.spec import STRIDE, score_size
from psiamfcpp.tracking.confidence import State, StateMachine, confidence
from psiamfcpp.tracking.contest import Contest
from psiamfcpp.tracking.procedure import Estimate, FloatMap, Target, contrast, cosine_window, estimate, hidden, smooth
from psiamfcpp.zoo import DEFAULT_MODEL

# Sides below this are not followed down, unless the target began smaller (the original's lower bound).
_SMALLEST_SIDE = 10.0
# Velocity and size to look for again are running means over some ten frames: in the last ones before it vanishes a
# target is covered in part, seems small, and holds back. The velocity holds for a second of video.
_MEMORY_RATE, _COAST_FRAMES = 0.1, 30
# After so many frames without it, what is taken up elsewhere than expected may be something else.
_UNSEEN = 3
# What a lost target's search region is larger by than a followed one's.
_LOST_REACH = 1.3


@dataclass(frozen=True, slots=True)
class Look:
    """A look at a frame that the network has still to judge."""

    around: Target
    """centre and size that the region is laid about"""
    region: Image
    """search crop ``(S, S, 3)`` uint8, BGR"""
    kernels: Any
    """of the target's template, as the engine gave them"""


@dataclass(frozen=True, slots=True)
class Track:
    """The target in one frame."""

    box: Box
    """``(x, y, w, h)``, pixels, 0-based; while lost the network's best guess"""
    score: float
    """calibrated probability, 0..1, that the target is in the box; of the plain procedure, the network's own score"""
    state: State
    """tracking, unsure or lost; always tracking with the plain procedure"""


class Tracker:
    """Follows one target with SiamFC++'s procedure, made honest about loss.

    Args:
        model: name of a shipped model, or a model file.
        engine: what runs the network; by default onnx for exported graphs and torch for a checkpoint.
        threads: threads of the engine; by default all cores.
        search_size: side of the search crop in pixels; by default the model's own. 239 costs 40 % less than 303.
        plain: follow the published procedure exactly: no states, no search beyond the usual region. Use it to
            compare with published figures.

    Raises:
        UserError: unknown model, engine or size.
    """

    def __init__(
        self,
        model: str = DEFAULT_MODEL,
        engine: str | None = None,
        threads: int | None = None,
        search_size: int | None = None,
        plain: bool = False,
    ):
        self.engine: Engine = open_engine(model, engine, threads, search_size)
        spec = self.engine.spec
        self.spec = spec
        self._plain = plain
        cells = score_size(spec.search_size, spec.template_size)
        self._window = cosine_window(cells)
        # Half the width of the region in which targets can be found, in pixels of the search crop.
        self._reach = cells * STRIDE / 2
        self._buffer = np.empty((spec.search_size, spec.search_size, 3), np.uint8)
        self._kernels: Any = None

    def init(self, frame: Image, box: ArrayLike) -> Track:
        """Take up a target.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.
            box: ``(x, y, w, h)`` of the target, pixels, 0-based.

        Raises:
            UserError: the frame is no such image, or the box is not one that can be tracked in it.
        """
        _check_frame(frame)
        x, y, w, h = check_box(box, frame.shape)
        cx, cy = (float(v) for v in centre((x, y, w, h)))
        self._target = Target(cx, cy, w, h)
        self._smallest = min(_SMALLEST_SIDE, w, h)
        self._fill = mean_colour(frame)
        self._states = StateMachine(self.spec.calibration)
        self._seen = self._target
        self._velocity = (0.0, 0.0)
        self._unseen_for = self._lost_for = 0
        self._contest: Contest | None = None
        size = self.spec.template_size
        self._kernels = self.engine.template(target_crop(frame, (cx, cy, w, h), size, size, self._fill))
        return Track((x, y, w, h), 1.0, "tracking")

    def update(self, frame: Image) -> Track:
        """Find the target in the next frame.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR; its size may differ from the first frame's.

        Raises:
            UserError: `init` was not called, or the frame is no such image.
        """
        look = self.aim(frame)
        return self.conclude(frame, look, *self.engine.search(look.region, look.kernels))

    def aim(self, frame: Image, out: Image | None = None) -> Look:
        """The first half of `update`: where to look in the next frame; the tracker itself stays as it is.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.
            out: buffer ``(S, S, 3)`` for the region; by default one that the next look overwrites.

        Raises:
            UserError: `init` was not called, or the frame is no such image.
        """
        if self._kernels is None:
            raise UserError("update() before init(): give the tracker a box on a first frame")
        _check_frame(frame)
        around = self._where_to_look(frame.shape)
        return Look(around, self._region(frame, around, self._buffer if out is None else out), self._kernels)

    def conclude(self, frame: Image, look: Look, scores: FloatMap, boxes: FloatMap) -> Track:
        """The second half of `update`: what the network's answer to a look means for the target.

        Args:
            frame: the frame that was looked at.
            look: what `aim` gave for it.
            scores: ``(N, N)``.
            boxes: ``(N, N, 4)`` as x0, y0, x1, y1 in pixels of the region.
        """
        found, apart = self._read(look.around, scores, boxes)
        if self._plain:
            rate = self.spec.constants.test_lr * found.penalty * found.score
            self._target = self._moved(self._target, found, rate, frame)
            return Track(self._box(), found.score, "tracking")
        value = confidence(found.score, apart, self.spec.calibration)
        return self._judge(frame, look.around, found, value)

    def look(self, frame: Image, around: Target) -> tuple[Estimate, float]:
        """What one search region says; the tracker itself stays as it is.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.
            around: centre and size of the target that the region is laid about.

        Returns:
            The estimate, and its contrast (see `psiamfcpp.tracking.procedure.contrast`).
        """
        region = self._region(frame, around, self._buffer)
        return self._read(around, *self.engine.search(region, self._kernels))

    def another(self) -> Tracker:
        """A tracker without a target yet, on the same engine and with the same options."""
        other = copy.copy(self)
        other._buffer = np.empty_like(self._buffer)
        other._kernels = None
        return other

    def _region(self, frame: Image, around: Target, out: Image) -> Image:
        spec = self.spec
        place = (around.cx, around.cy, around.w, around.h)
        return target_crop(frame, place, spec.search_size, spec.template_size, self._fill, out)

    def _read(self, around: Target, scores: FloatMap, boxes: FloatMap) -> tuple[Estimate, float]:
        spec = self.spec
        found = estimate(scores, boxes, around, spec.search_size, spec.template_size, spec.constants, self._window)
        return found, contrast(scores, boxes, found.cell)

    def _judge(self, frame: Image, around: Target, found: Estimate, value: float) -> Track:
        """Move as far as the confidence allows, and say what state that is."""
        was_lost = self._states.state == "lost"
        guess, gone_on = self._target, self._gone_on(self._target, frame)
        expected = _lies_in(found.target, self._seen if was_lost else gone_on)
        state = self._states.step(value, elsewhere=not expected)
        if state == "tracking":
            last_seen = self._gone_on(self._seen, frame)
            if self._unseen_for >= _UNSEEN and not _lies_in(found.target, last_seen):
                self._contest = Contest(last_seen, self._velocity)
            rate = self.spec.constants.test_lr * found.penalty * found.score
            self._target = self._moved(around, found, rate, frame)
            self._see()
            value = self._contested(frame, found.score, value)
            return Track(self._box(), value, state)
        self._unseen_for += 1
        self._seen = self._gone_on(self._seen, frame)
        self._lost_for = self._lost_for + 1 if state == "lost" else 0
        if state == "lost":
            self._contest = None
        if state == "unsure" and value < self.spec.calibration.lost_below and not expected:
            self._target = gone_on
        elif around == guess:
            self._target = self._moved(guess, found, 0.0, frame)
        return Track(self._box(), value, state)

    def _contested(self, frame: Image, score: float, value: float) -> float:
        """Look where the target was expected too, while that has a say, and change over to what wins there.

        Args:
            frame: the frame that is looked at.
            score: of what is followed.
            value: the confidence in it.

        Returns:
            The confidence in what is followed from now on.
        """
        contest, limits = self._contest, self.spec.calibration
        if contest is None:
            return value
        around = contest.place
        scores, boxes = self.engine.search(self._region(frame, around, self._buffer), self._kernels)
        scores = hidden(scores, boxes, around, self._target, self.spec.search_size, self.spec.template_size)
        found, apart = self._read(around, scores, boxes)
        rival = confidence(found.score, apart, limits)
        won = contest.judge(found.target, rival >= limits.regain_above, found.score - score)
        if won:
            self._target = self._seen = dataclasses.replace(around, cx=found.target.cx, cy=found.target.cy)
            self._velocity = contest.velocity
        if won or contest.looks_left == 0:
            self._contest = None
        return rival if won else value

    def _where_to_look(self, frame_shape: tuple[int, ...]) -> Target:
        """The target's place; while lost also, by turns, where it was seen last, and a region about it that grows."""
        if self._lost_for % 2 == 0:
            return self._target
        t = dataclasses.replace(self._seen, w=self._seen.w * _LOST_REACH, h=self._seen.h * _LOST_REACH)
        column, row = spiral(self._lost_for // 2 + 1)
        step = self._reach * context_side(t.w, t.h) / self.spec.template_size
        height, width = frame_shape[:2]
        cx, cy = t.cx + column * step, t.cy + row * step
        if not (0 <= cx < width and 0 <= cy < height):
            # Rather than look outside the frame, look again where it was last seen.
            return t
        return Target(cx, cy, t.w, t.h)

    def _moved(self, around: Target, found: Estimate, rate: float, frame: Image) -> Target:
        return smooth(around, found, rate, frame.shape, self._smallest)

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
        """A target a frame later, moving as when it was last seen: most that vanish do so behind what they pass."""
        if self._unseen_for > _COAST_FRAMES:
            return t
        (vx, vy), (height, width) = self._velocity, frame.shape[:2]
        return Target(min(max(t.cx + vx, 0.0), width - 1.0), min(max(t.cy + vy, 0.0), height - 1.0), t.w, t.h)

    def _box(self) -> Box:
        return from_centre(self._target.cx, self._target.cy, self._target.w, self._target.h)


def _lies_in(found: Target, box: Target) -> bool:
    return abs(found.cx - box.cx) < box.w / 2 and abs(found.cy - box.cy) < box.h / 2


def spiral(n: int) -> tuple[int, int]:
    """Column and row of the square to look at in the ``n``-th look about the place of the loss (from 1).

    Every other look is at the place of the loss itself, where most targets reappear; those between walk the
    rings of squares about it, of which each is entered only when the one inside it was seen whole. After four rings
    the walk begins anew.
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


def _check_frame(frame: Image) -> None:
    is_array = isinstance(frame, np.ndarray) and frame.dtype == np.uint8 and frame.size > 0
    if not is_array or frame.ndim != 3 or frame.shape[2] != 3:
        shape = f"{frame.dtype} {frame.shape}" if isinstance(frame, np.ndarray) else type(frame).__name__
        raise UserError(f"frame is {shape}: an array (height, width, 3) of uint8, BGR, is needed")
