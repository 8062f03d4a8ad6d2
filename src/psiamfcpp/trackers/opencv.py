"""OpenCV's own trackers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import ArrayLike

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image, check_box, check_frame
from psiamfcpp.trackers.contract import Track
from psiamfcpp.trackers.identity import tracker_identity

FILES = {
    "TrackerNano": ("backbone", "neckhead"),
    "TrackerVit": ("net",),
    "TrackerDaSiamRPN": ("model", "kernel_cls1", "kernel_r1"),
}
"""options that hold model files, by OpenCV's name of the tracker"""

_CONTRIB = ("csrt", "kcf")


def opencv_trackers() -> list[str]:
    """Return the names of the trackers that the installed OpenCV has."""
    return sorted(name.removesuffix("_create") for name in dir(cv2) if name.startswith("Tracker") and "_create" in name)


def open_tracker(name: str, options: Mapping[str, str]) -> OpenCvTracker:
    """Open a tracker of OpenCV.

    Args:
        name: ``mil``, ``nano``, ``vit`` and so on, in any case.
        options: files of its networks, by the names in `FILES`.

    Raises:
        UserError: the installed OpenCV has no such tracker, or a file is missing or no model.
    """
    known = opencv_trackers()
    full = next((k for k in known if k.lower() == f"tracker{name.lower()}"), None)
    if full is None:
        short = ", ".join(k.removeprefix("Tracker").lower() for k in known)
        hint = "; it is in opencv-contrib-python-headless, and benchmarks/peers.sh makes an environment with that"
        hint = hint if name.lower() in _CONTRIB else ""
        raise UserError(f"OpenCV has no tracker {name!r} here: there are {short}{hint}")
    wanted = FILES.get(full, ())
    if set(options) != set(wanted):
        form = f"opencv:{name.lower()}" + "".join(f",{part}=FILE" for part in wanted)
        raise UserError(f"tracker opencv:{name} has options {', '.join(options) or 'none'}: give {form}")
    lacking = next((path for path in options.values() if not Path(path).is_file()), None)
    if lacking is not None:
        raise UserError(f"model file {lacking!r} of {full} does not exist")
    return OpenCvTracker(full, options)


class OpenCvTracker:
    """See `psiamfcpp.trackers.contract.Tracker`. These trackers take whole pixels, and are built anew per target."""

    def __init__(self, name: str, files: Mapping[str, str]):
        self._opencv_name, self._files = name, dict(files)
        self.name = f"opencv-{name.removeprefix('Tracker').lower()}"
        self._tracker: Any = self._create()

    @property
    def identity(self) -> dict[str, Any]:
        """See `psiamfcpp.trackers.contract.Tracker`."""
        return tracker_identity(self.name.replace("-", ":", 1), self._files)

    def init(self, frame: Image, box: ArrayLike) -> Track:
        """See `psiamfcpp.trackers.contract.Tracker`."""
        check_frame(frame)
        self._box: Box = check_box(box, frame.shape)
        self._tracker = self._create()
        self._call(self._tracker.init, frame, tuple(round(v) for v in self._box))
        return Track(self._box)

    def update(self, frame: Image) -> Track:
        """Find the target; where OpenCV sees nothing its box means nothing, and the last one stands."""
        found, box = self._call(self._tracker.update, frame)
        if found:
            x, y, w, h = (float(v) for v in box)
            self._box = (x, y, w, h)
        return Track(self._box)

    def close(self) -> None:
        """Nothing is held."""

    def _create(self) -> Any:
        # it warns of its own network engine at every start
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
        try:
            create = getattr(cv2, f"{self._opencv_name}_create")
            if not self._files:
                return create()
            parameters = getattr(cv2, f"{self._opencv_name}_Params")()
            for part, path in self._files.items():
                setattr(parameters, part, path)
            return create(parameters)
        except cv2.error as error:
            raise UserError(f"OpenCV cannot open {self._opencv_name} ({error.err}): check its model files") from None
        finally:
            cv2.utils.logging.setLogLevel(level)

    def _call(self, function: Any, *args: Any) -> Any:
        try:
            return function(*args)
        except cv2.error as error:
            raise UserError(f"OpenCV's {self._opencv_name} failed: {error.err}") from None
