"""Tracker classes of others, which follow the contract of the GOT-10k toolkit."""

from __future__ import annotations

import ast
import contextlib
import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image
from psiamfcpp.trackers.contract import Track
from psiamfcpp.trackers.identity import tracker_identity

_FORMATS = ("rgb", "bgr", "pil")


def open_tracker(name: str, options: Mapping[str, str]) -> ForeignTracker:
    """Open ``pkg.mod:Class``, built with the options as keyword arguments (numbers and true/false as such).

    Raises:
        UserError: it cannot be imported or built, or lacks ``init`` or ``update``.
    """
    return ForeignTracker(name, options)


class ForeignTracker:
    """A class with ``init(image, box)`` and ``update(image)``, which returns the box.

    Its attribute ``image_format`` says what it takes: ``"rgb"``, an array ``(H, W, 3)`` uint8 (the default), ``"bgr"``,
    the same in OpenCV's order, or ``"pil"``, an RGB ``PIL.Image``, which the GOT-10k toolkit itself hands out.
    """

    def __init__(self, entry: str, options: Mapping[str, str]):
        self._entry, self._options = entry, dict(options)
        module, _, name = entry.rpartition(":")
        if not (module and name):
            raise UserError(f"tracker {entry!r} names no class: write module:pkg.mod:Class")
        self.name = name
        try:
            with _quiet():
                found = importlib.import_module(module)
                built = getattr(found, name)
                self._tracker = built(**{key: _value(value) for key, value in options.items()})
        except Exception as error:
            text = f"tracker {entry!r} cannot be opened ({type(error).__name__}: {error}): module:Class is needed, "
            raise UserError(text + "importable from here and built without arguments but the given keys") from error
        # who edits a class wants it run anew, and not its results of before
        code = getattr(found, "__file__", None)
        self._code = [Path(code)] if code else []
        missing = [call for call in ("init", "update") if not callable(getattr(self._tracker, call, None))]
        if missing:
            raise UserError(f"tracker {entry!r} has no {missing[0]}(): init(image, box) and update(image) are needed")
        self._format = getattr(self._tracker, "image_format", "rgb")
        if self._format not in _FORMATS:
            raise UserError(f"tracker {entry!r} has image_format {self._format!r}: known are {', '.join(_FORMATS)}")

    @property
    def identity(self) -> dict[str, Any]:
        """See `psiamfcpp.trackers.contract.Tracker`."""
        return tracker_identity(self._entry, self._options, self._code)

    def init(self, frame: Image, box: ArrayLike) -> Track:
        """See `psiamfcpp.trackers.contract.Tracker`."""
        start = np.array(box, np.float64).reshape(4)
        self._call("init", self._image(frame), start.copy())
        return Track(_as_box(start))

    def update(self, frame: Image) -> Track:
        """See `psiamfcpp.trackers.contract.Tracker`."""
        box = self._call("update", self._image(frame))
        try:
            return Track(_as_box(np.asarray(box, np.float64).reshape(4)))
        except (TypeError, ValueError):
            raise UserError(f"tracker {self._entry!r} returned {box!r:.60}: a box x,y,w,h is needed") from None

    def close(self) -> None:
        """Call the class's own ``close``, if it has one."""
        if callable(getattr(self._tracker, "close", None)):
            self._call("close")

    def _call(self, name: str, *args: Any) -> Any:
        try:
            with _quiet():
                return getattr(self._tracker, name)(*args)
        except Exception as error:
            # the cause stays attached for those who call from Python
            text = f"tracker {self._entry!r} failed in {name}() ({type(error).__name__}: {error}): fix the class"
            raise UserError(text) from error

    def _image(self, frame: Image) -> Any:
        if self._format == "bgr":
            return frame
        rgb = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        if self._format == "rgb":
            return rgb
        try:
            from PIL import Image as PilImage
        except ModuleNotFoundError:
            raise UserError(f"tracker {self._entry!r} takes PIL images: pip install pillow") from None
        return PilImage.fromarray(rgb)


def _quiet() -> contextlib.AbstractContextManager[object]:
    """Send what others print to standard error: standard output is for results."""
    return contextlib.redirect_stdout(sys.stderr)


def _as_box(values: Any) -> Box:
    x, y, w, h = (float(v) for v in values)
    return (x, y, w, h)


def _value(text: str) -> Any:
    """Return numbers and true/false as such, and anything else as text."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    with contextlib.suppress(ValueError, SyntaxError):
        value = ast.literal_eval(text)
        return value if isinstance(value, int | float) else text
    return text
