"""The SiamFC++ tracker: an engine and the state of one target."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.runtime import Engine, open_engine
from psiamfcpp.trackers.contract import Track
from psiamfcpp.trackers.identity import checksum
from psiamfcpp.trackers.siamfcpp.following import Following
from psiamfcpp.trackers.siamfcpp.options import TrackerOptions
from psiamfcpp.trackers.siamfcpp.procedure import Estimate, Target
from psiamfcpp.zoo import DEFAULT_MODEL, model_files

_DEFAULT = TrackerOptions()


class Tracker:
    """Follows one target with SiamFC++'s procedure, and says when the target is lost.

    Args:
        model: name of a shipped model, or a model file.
        engine: what runs the network: a name (see `TrackerOptions`), or an engine object of your own (see
            `psiamfcpp.runtime.Engine`), which then goes before ``model``.
        options: how the model runs.
        changes: single fields of ``options``, as ``Tracker(plain=True)``.

    Raises:
        UserError: unknown model, engine, device or size.
    """

    def __init__(
        self,
        model: str = DEFAULT_MODEL,
        engine: str | Engine | None = None,
        *,
        options: TrackerOptions = _DEFAULT,
        **changes: Any,
    ):
        self._own_engine = engine is not None and not isinstance(engine, str)
        if engine is None or isinstance(engine, str):
            self.options = o = dataclasses.replace(options, engine=engine or options.engine, **changes)
            self.engine: Engine = open_engine(model, o.engine, o.threads, o.search_size, o.device)
            self.name = Path(model).stem if Path(model).is_file() else Path(model).name
        else:
            self.options = dataclasses.replace(options, **changes)
            self.engine, self.name = engine, type(engine).__name__
        self._model = model
        self.spec = self.engine.spec
        """the model's description; replaced before `init`, its constants and calibration are used instead"""
        self._following: Following | None = None

    @property
    def identity(self) -> dict[str, Any]:
        """See `psiamfcpp.trackers.contract.Tracker`."""
        files = [] if self._own_engine else model_files(self._model)
        return model_identity(self.name, checksum(files), self.options)

    def init(self, frame: Image, box: ArrayLike) -> Track:
        """Start to follow a target.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.
            box: ``(x, y, w, h)`` of the target, pixels, 0-based.

        Returns:
            The box itself with a score of 1.

        Raises:
            UserError: the frame is no such image, or the box cannot be tracked in it.
        """
        self._following = self.follow(frame, box)
        return self._following.first

    def update(self, frame: Image) -> Track:
        """Find the target in the next frame.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR; its size may differ from the first frame's.

        Returns:
            The target. Its score is the calibrated probability, 0..1, that the target is in the box; of the plain
            procedure, the network's own score. Its state is always tracking with the plain procedure.

        Raises:
            UserError: `init` was not called, or the frame is no such image.
        """
        return self.following.update(frame, self.engine)

    def look(self, frame: Image, around: Target) -> tuple[Estimate, float]:
        """Return what one search region says; the state stays as it is.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.
            around: centre and size of the target that the region is laid about.

        Returns:
            The estimate, and its contrast (see `psiamfcpp.trackers.siamfcpp.procedure.contrast`).

        Raises:
            UserError: `init` was not called.
        """
        following = self.following
        look = following.look_at(frame, around)
        return following.read(around, *self.engine.search(look.region, look.kernels))

    def follow(self, frame: Image, box: ArrayLike) -> Following:
        """Return the state of one more target on this engine (see `update_many`); takes what `init` takes."""
        return Following(self.engine, self.spec, self.options.plain, frame, box)

    def close(self) -> None:
        """Forget the target; the engine goes with the tracker."""
        self._following = None

    @property
    def following(self) -> Following:
        """The state of the followed target.

        Raises:
            UserError: `init` was not called.
        """
        if self._following is None:
            raise UserError("update() before init(): give the tracker a box on a first frame")
        return self._following


def model_identity(name: str, files_checksum: str, options: TrackerOptions) -> dict[str, Any]:
    """Return everything that decides a model's boxes; the device only where it computes in another precision."""
    known = dataclasses.asdict(options)
    del known["threads"]
    if known["device"] == "cpu":
        del known["device"]
    return {"entry": name, "checksum": files_checksum, **known}


def update_many(engine: Engine, targets: Sequence[Following], frame: Image, regions: Image) -> list[Track]:
    """Find several targets in the next frame by one call of the engine.

    Args:
        engine: the engine that they all started on.
        targets: their states.
        frame: ``(H, W, 3)`` uint8, BGR.
        regions: buffer ``(len(targets), S, S, 3)`` uint8 for the search crops.

    Returns:
        One track per target.

    Raises:
        UserError: the frame is no such image.
    """
    looks = [target.aim(frame, out) for target, out in zip(targets, regions, strict=True)]
    scores, boxes = engine.search_many(np.asarray(regions), [look.kernels for look in looks])
    return [
        target.conclude(frame, look, scores[i], boxes[i], engine)
        for i, (target, look) in enumerate(zip(targets, looks, strict=True))
    ]
