"""Several targets on one engine: one call of the engine a frame, and a state each."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.geometry import Image
from psiamfcpp.spec import ModelSpec
from psiamfcpp.tracking.tracker import Look, Track, Tracker
from psiamfcpp.zoo import DEFAULT_MODEL


class TargetPool:
    """Follows any number of targets, each as a `Tracker` of its own would. Takes what `Tracker` takes.

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
        self._first = Tracker(model, engine, threads, search_size, plain)
        self._trackers: dict[int, Tracker] = {}
        self._last_number = 0
        size = self.spec.search_size
        self._regions = np.empty((0, size, size, 3), np.uint8)

    @property
    def spec(self) -> ModelSpec:
        """The model's description."""
        return self._first.spec

    @property
    def numbers(self) -> list[int]:
        """Numbers of the targets that are followed, in the order in which they were taken up."""
        return list(self._trackers)

    def add(self, frame: Image, box: ArrayLike) -> tuple[int, Track]:
        """Take up one more target.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.
            box: ``(x, y, w, h)`` of the target, pixels, 0-based.

        Returns:
            The target's number, from 1 and never given twice, and its first track.

        Raises:
            UserError: the frame is no such image, or the box is not one that can be tracked in it.
        """
        tracker = self._first.another()
        track = tracker.init(frame, box)
        self._last_number += 1
        self._trackers[self._last_number] = tracker
        return self._last_number, track

    def remove(self, number: int) -> None:
        """Let go of a target; nothing happens where there is none of that number."""
        self._trackers.pop(number, None)

    def update(self, frame: Image) -> dict[int, Track]:
        """Find every target in the next frame.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.

        Returns:
            A track for each number; none where no target is followed.

        Raises:
            UserError: the frame is no such image.
        """
        count = len(self._trackers)
        if count <= 1:
            return {number: tracker.update(frame) for number, tracker in self._trackers.items()}
        if len(self._regions) < count:
            self._regions = np.empty((count, *self._regions.shape[1:]), np.uint8)
        looks: list[Look] = [
            tracker.aim(frame, out) for tracker, out in zip(self._trackers.values(), self._regions[:count], strict=True)
        ]
        scores, boxes = self._first.engine.search_many(self._regions[:count], [look.kernels for look in looks])
        return {
            number: tracker.conclude(frame, look, scores[i], boxes[i])
            for i, ((number, tracker), look) in enumerate(zip(self._trackers.items(), looks, strict=True))
        }
