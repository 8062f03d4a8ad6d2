"""A correlation filter as a tracker of this package: checks of frames and boxes, and the score."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image, check_box
from psiamfcpp.trackers.contract import Track

# Targets with a larger geometric mean of sides are followed in a frame of every n-th pixel: windows are several times
# as wide as the target, and not all filters limit them. No benchmark has such a target.
_LARGEST_SIDE = 1000.0


class Filter(Protocol):
    """One target's filter; made from the first frame, ``(H, W, 3)`` uint8, BGR, its box and the constants."""

    def __init__(self, frame: Image, box: Box, constants: Any) -> None: ...

    def update(self, frame: Image) -> tuple[Box, NDArray[Any]]:
        """The box in the next frame, and the response ``(rows, columns)`` that it was found in; its origin is free."""
        ...


class DcfTracker:
    """Follows one target with a correlation filter; see `psiamfcpp.trackers.dcf.open_dcf`.

    The score is the response's peak-to-sidelobe ratio; it is not calibrated, and differs between filters. No state is
    given. The four numbers of a box are taken as the authors' code takes them: as they stand in the benchmarks' label
    files, where the first pixel is 1. For boxes that count from 0 the patch lies one pixel up and left of the target;
    the boxes given back keep the target's place all the same.
    """

    def __init__(self, name: str, kind: type[Filter], constants: Any):
        self._name, self._kind, self._constants = name, kind, constants
        self._filter: Filter | None = None
        self._step = 1

    @property
    def name(self) -> str:
        """Short name, such as ``kcf``."""
        return self._name

    @property
    def identity(self) -> Mapping[str, Any]:
        """What decides the boxes: the filter and its constants."""
        return {"kind": "dcf", "name": self._name, "constants": dataclasses.asdict(self._constants)}

    def init(self, frame: Image, box: ArrayLike) -> Track:
        """Start to follow a target.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.
            box: ``(x, y, w, h)`` of the target in pixels; its centre must lie in the frame.

        Raises:
            UserError: the frame is no such image, or the box cannot be tracked in it.
        """
        _check_frame(frame)
        start = check_box(box, frame.shape)
        self._filter = None  # an init that fails must not leave the target before
        x, y, w, h = start
        step = self._step = math.ceil(math.sqrt(w * h) / _LARGEST_SIDE)
        inside = ((x - 1) / step + 1, (y - 1) / step + 1, w / step, h / step)
        self._filter = self._kind(self._decimated(frame), inside, self._constants)
        return Track(start)

    def update(self, frame: Image) -> Track:
        """Find the target in the next frame ``(H, W, 3)`` uint8, BGR; its size may differ from the first frame's.

        Raises:
            UserError: `init` was not called, or the frame is no such image.
        """
        if self._filter is None:
            raise UserError("update() before init(): give the tracker a box on a first frame")
        _check_frame(frame)
        (x, y, w, h), response = self._filter.update(self._decimated(frame))
        n = self._step
        return Track(((x - 1) * n + 1, (y - 1) * n + 1, w * n, h * n), peak_to_sidelobe(response))

    def _decimated(self, frame: Image) -> Image:
        return frame if self._step == 1 else np.ascontiguousarray(frame[:: self._step, :: self._step])

    def close(self) -> None:
        """Release the target."""
        self._filter = None


def peak_to_sidelobe(response: NDArray[Any]) -> float:
    """Peak of a response above the mean of its sidelobe, in standard deviations (Bolme et al., CVPR 2010, section 3.5).

    The sidelobe is all but a square about the peak, of 11 cells, in small responses of a quarter of the shorter side;
    the response is cyclic. 0 for a response without a sidelobe.
    """
    rows, columns = response.shape
    reach = min(5, min(rows, columns) // 8)
    peak = np.unravel_index(int(np.argmax(response)), response.shape)
    sidelobe = np.ones((rows, columns), bool)
    around = np.arange(-reach, reach + 1)
    sidelobe[np.ix_((peak[0] + around) % rows, (peak[1] + around) % columns)] = False
    rest = response[sidelobe].astype(np.float64)
    spread = float(rest.std()) if rest.size else 0.0
    return float((response[peak] - rest.mean()) / spread) if spread > 0 else 0.0


def _check_frame(frame: Image) -> None:
    is_array = isinstance(frame, np.ndarray) and frame.dtype == np.uint8 and frame.size > 0
    if not is_array or frame.ndim != 3 or frame.shape[2] != 3:
        shape = f"{frame.dtype} {frame.shape}" if isinstance(frame, np.ndarray) else type(frame).__name__
        raise UserError(f"frame is {shape}: an array (height, width, 3) of uint8, BGR, is needed")
