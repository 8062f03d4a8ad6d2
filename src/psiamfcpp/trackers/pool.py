"""Several targets at once, with any tracker."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.geometry import Image, check_frame
from psiamfcpp.runtime import Engine
from psiamfcpp.trackers.contract import Track
from psiamfcpp.trackers.contract import Tracker as AnyTracker
from psiamfcpp.trackers.opening import TrackerChoice, choose
from psiamfcpp.trackers.siamfcpp import Tracker, TrackerOptions
from psiamfcpp.trackers.siamfcpp.following import Following
from psiamfcpp.trackers.siamfcpp.tracker import update_many
from psiamfcpp.zoo import DEFAULT_MODEL


class TargetPool:
    """Follows any number of targets, each as a tracker of its own would.

    Targets of one of our models share an engine, and are searched for by one call of it per frame. With any other
    tracker, each target has a tracker of its own.

    Args:
        tracker: what follows them: our models, or any other tracker (see `psiamfcpp.open_tracker`).
        engine: what runs our model: a name, or an engine object, which then goes before ``tracker``.
        options: how our model runs.
        changes: single fields of ``options``, as ``TargetPool(threads=1)``.

    Raises:
        UserError: unknown tracker or wrong options.
    """

    def __init__(
        self,
        tracker: str = DEFAULT_MODEL,
        engine: str | Engine | None = None,
        *,
        options: TrackerOptions = TrackerOptions(),  # noqa: B008 - frozen
        **changes: Any,
    ):
        self._group: _OneEngine | _OneEach = _group(tracker, engine, options, changes)
        self._last_number = 0

    @property
    def name(self) -> str:
        """Name of the tracker."""
        return self._group.name

    @property
    def numbers(self) -> list[int]:
        """Numbers of the targets that are followed, in the order in which they were added."""
        return list(self._group.targets)

    def add(self, frame: Image, box: ArrayLike) -> tuple[int, Track]:
        """Start to follow one more target.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.
            box: ``(x, y, w, h)`` of the target, pixels, 0-based.

        Returns:
            The target's number, from 1 and never given twice, and its first track.

        Raises:
            UserError: the frame is no such image, or the box cannot be tracked in it.
        """
        track = self._group.add(self._last_number + 1, frame, box)
        self._last_number += 1
        return self._last_number, track

    def remove(self, number: int) -> None:
        """Stop following a target; nothing happens where there is none of that number."""
        self._group.remove(number)

    def update(self, frame: Image) -> dict[int, Track]:
        """Find every target in the next frame.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.

        Returns:
            A track for each number; none where no target is followed.

        Raises:
            UserError: the frame is no such image.
        """
        if self._group.targets:
            check_frame(frame)
        return self._group.update(frame)

    def update_one(self, number: int, frame: Image) -> Track:
        """Find one target in a frame, and leave the others as they are: to catch up with them.

        Args:
            number: of the target.
            frame: ``(H, W, 3)`` uint8, BGR.

        Raises:
            UserError: the frame is no such image.
        """
        check_frame(frame)
        return self._group.update_one(number, frame)

    def close(self) -> None:
        """Stop following all targets and release what their trackers hold."""
        for number in self.numbers:
            self.remove(number)
        self._group.close()


class _OneEngine:
    """Targets of one of our models, on one engine."""

    def __init__(self, tracker: Tracker):
        self._tracker = tracker
        self.name = tracker.name
        self.targets: dict[int, Following] = {}
        size = tracker.spec.search_size
        self._regions = np.empty((0, size, size, 3), np.uint8)

    def add(self, number: int, frame: Image, box: ArrayLike) -> Track:
        self.targets[number] = target = self._tracker.follow(frame, box)
        return target.first

    def remove(self, number: int) -> None:
        self.targets.pop(number, None)

    def update(self, frame: Image) -> dict[int, Track]:
        engine, count = self._tracker.engine, len(self.targets)
        if count <= 1:
            return {number: target.update(frame, engine) for number, target in self.targets.items()}
        if len(self._regions) < count:
            self._regions = np.empty((count, *self._regions.shape[1:]), np.uint8)
        tracks = update_many(engine, list(self.targets.values()), frame, self._regions[:count])
        return dict(zip(self.targets, tracks, strict=True))

    def update_one(self, number: int, frame: Image) -> Track:
        return self.targets[number].update(frame, self._tracker.engine)

    def close(self) -> None:
        self._tracker.close()


class _OneEach:
    """Targets that have a tracker each; one is opened ahead, so that a wrong choice is refused at once."""

    def __init__(self, choice: TrackerChoice, first: AnyTracker):
        self._choice = choice
        self._spare: AnyTracker | None = first
        self.name = choice.name
        self.targets: dict[int, AnyTracker] = {}

    def add(self, number: int, frame: Image, box: ArrayLike) -> Track:
        tracker = self._spare = self._spare or self._choice.open()
        track = tracker.init(frame, box)
        self.targets[number], self._spare = tracker, None
        return track

    def remove(self, number: int) -> None:
        tracker = self.targets.pop(number, None)
        if tracker is not None:
            tracker.close()

    def update(self, frame: Image) -> dict[int, Track]:
        return {number: tracker.update(frame) for number, tracker in self.targets.items()}

    def update_one(self, number: int, frame: Image) -> Track:
        return self.targets[number].update(frame)

    def close(self) -> None:
        if self._spare is not None:
            self._spare.close()


def _group(
    tracker: str, engine: str | Engine | None, options: TrackerOptions, changes: dict[str, Any]
) -> _OneEngine | _OneEach:
    if engine is not None and not isinstance(engine, str):
        return _OneEngine(Tracker(tracker, engine, options=options, **changes))
    choice = choose(tracker, dataclasses.replace(options, engine=engine or options.engine, **changes))
    opened = choice.open()
    return _OneEngine(opened) if isinstance(opened, Tracker) else _OneEach(choice, opened)
