"""The state of one followed target: where to search next, and what the network's answer means for the target.

No engine is held here: `Following.aim` says what to search, and whoever owns an engine hands the answer to
`Following.conclude`. So one engine can serve any number of targets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.geometry import Box, Image, centre, check_box, check_frame, from_centre
from psiamfcpp.models.arch import opened
from psiamfcpp.runtime import Engine
from psiamfcpp.spec import Calibration, ModelSpec
from psiamfcpp.trackers.contract import State, Track
from psiamfcpp.trackers.siamfcpp.camera import STILL, Camera
from psiamfcpp.trackers.siamfcpp.confidence import StateMachine, confidence
from psiamfcpp.trackers.siamfcpp.hunt import Hunt, lies_in, proof_level
from psiamfcpp.trackers.siamfcpp.procedure import (
    Estimate,
    FloatMap,
    Procedure,
    Target,
    contrast,
    hidden,
)

# Running means over about 10 frames. Just before a target disappears it is partly occluded and its size and speed are
# underestimated; a mean is not.
_MEMORY_RATE = 0.1
# After this many frames without the target, what is re-acquired away from its expected place may be another object; for
# _WATCH frames the expected place is looked at as well.
_UNSEEN, _WATCH = 3, 25
# After this many frames of proof since it was last in doubt, the target is from now on expected where it is followed.
_SETTLED = 10
# After this many frames without the target it is searched for elsewhere.
SEARCH_AFTER = 5
# Kernels of later looks are kept beside those of the first frame, one after this many sure frames in a row.
_LOOKS, LOOK_EVERY = 2, 30
# Where no cell has any score, the window still decides for the middle.
_LEAST_HEIGHT = 1e-6
# A frame whose grey levels, at one pixel in 16 by 16, spread by less than this shows nothing but noise.
_BLANK_SPREAD, _SAMPLED = 1.5, 16


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
        self._flat = np.ones_like(self._window)
        # Half the width of the region in which targets can be found, in pixels of the search crop.
        self._reach = cells * spec.arch.stride / 2
        self._buffer = np.empty((spec.search_size, spec.search_size, 3), np.uint8)
        self._target = self._seen = Target(cx, cy, w, h)
        self._smallest = min(self._procedure.smallest, w, h)
        self._fill = self._procedure.fill(frame)
        self._states = StateMachine(self._limits)
        self._velocity = (0.0, 0.0)
        self._unseen_for = self._watch = self._sure_for = self._proofs = 0
        self._camera = Camera()
        self._hunt: Hunt | None = None
        self._kernels, self._later = engine.template(self._template(frame)), list[Any]()

    def aim(self, frame: Image, out: Image | None = None) -> Look:
        """Return what to search in the next frame; the state stays as it is.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.
            out: buffer ``(S, S, 3)`` for the region; by default one that the next call overwrites.

        Raises:
            UserError: the frame is no such image.
        """
        check_frame(frame)
        return self.look_at(frame, self._target, out)

    def update(self, frame: Image, engine: Engine) -> Track:
        """Find the target in the next frame; takes a frame ``(H, W, 3)`` uint8, BGR, and the engine it started on."""
        look = self.aim(frame)
        return self.conclude(frame, look, *engine.search(look.region, look.kernels), engine)

    def look_at(self, frame: Image, around: Target, out: Image | None = None) -> Look:
        """Return the search region about a given place; the state stays as it is."""
        spec = self._spec
        buffer = self._buffer if out is None else out
        region = self._procedure.crop(frame, around, spec.search_size, spec.template_size, self._fill, buffer)
        return Look(around, region, self._kernels)

    def read(self, around: Target, scores: FloatMap, boxes: FloatMap) -> tuple[Estimate, float]:
        """Return the estimate of a searched region and its contrast (see `procedure.contrast`)."""
        window = self._window if self._plain else self._scaled_window(scores)
        found = self._procedure.estimate(scores, boxes, around, self._spec, window)
        return found, contrast(scores, boxes, found.cell)

    def _scaled_window(self, scores: FloatMap) -> FloatMap:
        """Return the window as high as the best score.

        The published procedure adds a window of height 1 to scores. Of a target that is hardly recognised all scores
        are low; the window then decides alone, and a target that has moved since the last frame is left behind.
        """
        return self._window * max(float(scores.max()), _LEAST_HEIGHT)

    def conclude(self, frame: Image, look: Look, scores: FloatMap, boxes: FloatMap, engine: Engine) -> Track:
        """Update the state by the network's answer, and return where the target is.

        Args:
            frame: the frame that was searched.
            look: what `aim` gave for it.
            scores: ``(N, N)``.
            boxes: ``(N, N, 4)`` as x0, y0, x1, y1 in pixels of the region.
            engine: that the target started on, for a second region and for looks to keep.
        """
        if not self._plain and _blank(frame):
            # No evidence: the target is where it was, and is searched for there first when the video is back.
            return Track(self._box(), 0.0, self._states.step(0.0))
        found, apart = self.read(look.around, scores, boxes)
        if self._plain:
            self._target = self._moved(self._target, found, self._rate(found), frame)
            return Track(self._box(), found.score, self._plain_state)
        value = confidence(found.score, apart, self._limits)
        return self._judge(frame, look.around, found, value, engine)

    def _judge(self, frame: Image, around: Target, found: Estimate, value: float, engine: Engine) -> Track:
        """Follow as the procedure does, and look elsewhere as well where that has lost the target."""
        frozen = False
        self._settle(value)
        if self._hunt:
            motion = self._camera.step(frame, self._target)
            frozen = motion is None
            if motion is not None:
                self._hunt.go_on(motion)
        rate = self._rate(found)
        if value < self._limits.unsure_below:
            rate *= self._procedure.rate_in_doubt
        self._target = self._moved(around, found, rate, frame)
        expected = self._hunt is None or lies_in(found.target, self._hunt.place)
        state = self._states.step(value, elsewhere=not expected)
        if state == "tracking":
            if expected:
                self._watch = 0
            elif self._unseen_for >= _UNSEEN:
                self._watch = _WATCH
            self._unseen_for = 0
        else:
            self._unseen_for += 1
            if self._hunt is None:
                self._hunt = Hunt(self._seen, self._velocity)
                self._camera.step(frame, self._target)
                self._hunt.go_on(STILL)
        # The same frame again proves nothing of a rival, but the target may be gone: a scene can be that still.
        if not frozen and (self._unseen_for >= SEARCH_AFTER or (self._watch and not self._unseen_for)):
            value = self._look_elsewhere(frame, value, engine)
        if not self._unseen_for and not self._watch:
            self._see()
            self._remember(frame, value, engine)
        return Track(self._box(), value, self._states.state)

    def _look_elsewhere(self, frame: Image, value: float, engine: Engine) -> float:
        """Search one more place, and switch to what has proved to be the target there.

        Args:
            frame: the frame that is searched.
            value: the confidence in what is followed.
            engine: that the target started on.

        Returns:
            The confidence in what is followed from now on.
        """
        hunt, watching = self._hunt, not self._unseen_for
        assert hunt is not None
        self._watch = max(self._watch - watching, 0)
        reach = self._reach / self._procedure.zoom(hunt.place, self._spec)
        around = hunt.place if watching and not hunt.rival else hunt.aim(reach, frame.shape, self._camera.movers)
        look = self.look_at(frame, around)
        kernels = [self._kernels, *self._later]
        scores, boxes = engine.search(look.region, kernels[hunt.turn % len(kernels)])
        if watching:
            zoom, middle = self._procedure.zoom(around, self._spec), self._procedure.middle(self._spec.search_size)
            scores = hidden(scores, boxes, around, self._target, zoom, middle)
        window = self._scaled_window(scores) if hunt.rival else self._flat
        found = self._procedure.estimate(scores, boxes, around, self._spec, window)
        rival = confidence(found.score, contrast(scores, boxes, found.cell), self._limits)
        target = self._moved(around, found, self._rate(found) if hunt.rival else 1.0, frame)
        if not hunt.judge(target, rival, value, self._limits):
            return value
        self._target = target
        self._watch = 0 if watching or lies_in(target, hunt.place) else _WATCH
        self._unseen_for, hunt.rival = 0, None
        self._states.regain()
        return rival

    def _settle(self, value: float) -> None:
        """End a search at the first doubt about something that has proved to be the target since the doubt before.

        Its expected place is of another time by then, and would favour whatever is there.
        """
        if value >= self._limits.unsure_below:
            self._proofs += value >= proof_level(self._limits)
            return
        if self._hunt and self._proofs >= _SETTLED:
            self._watch = 0
            self._see()
        self._proofs = 0

    def _moved(self, around: Target, found: Estimate, rate: float, frame: Image) -> Target:
        return self._procedure.move(around, found, rate, frame.shape, self._smallest)

    def _rate(self, found: Estimate) -> float:
        return self._procedure.rate(found, self._spec.constants)

    def _see(self) -> None:
        """Note where the target was seen, and how fast it moves."""
        t, before = self._target, self._seen
        if self._hunt is None:
            vx, vy = self._velocity
            dx, dy = t.cx - before.cx, t.cy - before.cy
            self._velocity = (vx + _MEMORY_RATE * (dx - vx), vy + _MEMORY_RATE * (dy - vy))
        w, h = (b + _MEMORY_RATE * (a - b) for a, b in ((t.w, before.w), (t.h, before.h)))
        self._seen, self._hunt = Target(t.cx, t.cy, w, h), None
        self._camera.forget()

    def _remember(self, frame: Image, value: float, engine: Engine) -> None:
        """Keep what the target looks like now, from time to time and where it is surely seen."""
        self._sure_for = self._sure_for + 1 if value >= self._limits.regain_above else 0
        if self._sure_for == LOOK_EVERY:
            self._later = [*self._later[1 - _LOOKS :], engine.template(self._template(frame))]
            self._sure_for = 0

    def _template(self, frame: Image) -> Image:
        size = self._spec.template_size
        return self._procedure.crop(frame, self._target, size, size, self._fill, None)

    def _box(self) -> Box:
        return from_centre(self._target.cx, self._target.cy, self._target.w, self._target.h)


def _blank(frame: Image) -> bool:
    """Return whether a frame shows nothing: a lost video signal, a covered lens."""
    return bool(frame[::_SAMPLED, ::_SAMPLED].std(axis=(0, 1)).max() < _BLANK_SPREAD)
