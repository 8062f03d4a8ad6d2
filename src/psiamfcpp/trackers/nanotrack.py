"""NanoTrack v2 and v3 (Honglin Chu, 2021-2023) by onnxruntime, from the user's model files.

The procedure and its constants are those of the published tracker (github.com/HonglinChu/SiamTrackers, NanoTrack,
Apache-2.0: ``nano_tracker.py``, ``configv2.yaml``, ``configv3.yaml``), which is SiamBAN's with other constants. The
networks take crops of 0..255, BGR, without normalization.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from psiamfcpp.crop import mean_colour
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image, centre, check_box, check_frame, context_side
from psiamfcpp.runtime.onnx_engine import open_session
from psiamfcpp.trackers.contract import Track

_TEMPLATE, _SEARCH, _STRIDE, _SMALLEST = 127, 255, 16, 10
_FILES = ("backbone", "head")
# The published backbones are made for search crops alone. In their protobuf text a fixed side of 255 takes as many
# bytes as a free one called "s", so that the input can be freed without the onnx package.
_FIXED_INPUT = b"\x0a\x02\x08\x03" + 2 * b"\x0a\x03\x08\xff\x01"
_FREE_INPUT = b"\x0a\x02\x08\x03" + 2 * b"\x0a\x03\x12\x01s"


@dataclass(frozen=True)
class Constants:
    """What the published configurations set, by hyper-parameter search over benchmarks."""

    cells: int
    """side of the score map"""
    window_influence: float
    """share of the cosine window in the score that selects the cell"""
    penalty_k: float
    """strength of the penalty for a change of scale and aspect ratio"""
    rate: float
    """how fast the size follows, before the factor of score and penalty"""


VERSIONS = {"v2": Constants(16, 0.490, 0.150, 0.385), "v3": Constants(15, 0.455, 0.138, 0.348)}


def open_nanotrack(version: str, options: Mapping[str, str], threads: int | None = None) -> NanoTrack:
    """Open NanoTrack.

    Args:
        version: v2 or v3.
        options: ``backbone`` and ``head``, the ONNX files.
        threads: threads of onnxruntime; by default all cores.

    Raises:
        UserError: another version, a missing option or file, or a file that is no such network.
    """
    if version not in VERSIONS:
        raise UserError(f"unknown version {version!r} of nanotrack: there are {', '.join(VERSIONS)}")
    backbone, head = nanotrack_files(options)
    return NanoTrack(version, backbone, head, threads)


def open_tracker(name: str, options: Mapping[str, str]) -> NanoTrack:
    """Open ``nanotrack:VERSION,...``; takes ``threads`` among the options."""
    files = {key: value for key, value in options.items() if key != "threads"}
    return open_nanotrack(name, files, int(options["threads"]) if "threads" in options else None)


def nanotrack_files(options: Mapping[str, str]) -> list[Path]:
    """Return the model files among the options, whose content is part of the tracker's identity.

    Raises:
        UserError: a file is not given or does not exist, or there is an option that NanoTrack lacks.
    """
    unknown = sorted(set(options) - set(_FILES))
    if unknown:
        raise UserError(f"nanotrack has no option {unknown[0]!r}: there are {', '.join(_FILES)}")
    for name in _FILES:
        if name not in options:
            raise UserError(f"nanotrack needs its {name}: give nanotrack:v3,backbone=FILE.onnx,head=FILE.onnx")
        if not Path(options[name]).is_file():
            raise UserError(f"{name} {options[name]} of nanotrack does not exist")
    return [Path(options[name]) for name in _FILES]


class NanoTrack:
    """See `psiamfcpp.trackers.contract.Tracker`; the score is the network's, 0..1, and there are no states."""

    def __init__(self, version: str, backbone: Path, head: Path, threads: int | None = None):
        self._version, self._constants = version, VERSIONS[version]
        self._files = {"backbone": backbone.read_bytes(), "head": head.read_bytes()}
        self._backbone = _open(_any_size(self._files["backbone"], backbone), backbone, threads)
        self._head = _open(self._files["head"], head, threads)
        cells = self._constants.cells
        line = (np.arange(cells) - cells // 2) * float(_STRIDE)
        self._columns, self._rows = np.meshgrid(line, line)
        self._window = np.outer(np.hanning(cells), np.hanning(cells))
        self._template: Any = None
        self._check(backbone, head)

    @property
    def name(self) -> str:
        """Short name, as tables and result folders show it."""
        return f"nanotrack-{self._version}"

    @property
    def identity(self) -> Mapping[str, Any]:
        """Version and checksums of the two files."""
        sums = {name: hashlib.sha256(data).hexdigest()[:16] for name, data in self._files.items()}
        return {"kind": "nanotrack", "version": self._version, **sums}

    def init(self, frame: Image, box: ArrayLike) -> Track:
        """Start to follow a target in a frame ``(H, W, 3)`` uint8, BGR; see the contract."""
        check_frame(frame)
        x, y, w, h = check_box(box, frame.shape)
        self._cx, self._cy = (float(v) for v in centre((x, y, w, h)))
        self._w, self._h = w, h
        # as whole numbers, since the published code pads images of whole numbers
        self._fill = tuple(int(value) for value in mean_colour(frame))
        self._template = self._features(frame, context_side(w, h), _TEMPLATE)
        return Track((x, y, w, h))

    def update(self, frame: Image) -> Track:
        """Find the target in the next frame ``(H, W, 3)`` uint8, BGR; see the contract."""
        if self._template is None:
            raise UserError("update() before init(): give the tracker a box on a first frame")
        check_frame(frame)
        side = context_side(self._w, self._h)
        scale = _TEMPLATE / side
        features = self._features(frame, side * _SEARCH / _TEMPLATE, _SEARCH)
        scores, sizes = self._run_head(features)
        left, top, right, bottom = sizes
        w, h = left + right, top + bottom
        penalty = self._penalty(w, h, scale)
        share = self._constants.window_influence
        cell = np.unravel_index(np.argmax(penalty * scores * (1 - share) + self._window * share), scores.shape)
        rate = float(penalty[cell] * scores[cell]) * self._constants.rate
        height, width = frame.shape[:2]
        # distances run from the cell's centre to the four sides
        cx = self._cx + float(self._columns[cell] + (right[cell] - left[cell]) / 2) / scale
        cy = self._cy + float(self._rows[cell] + (bottom[cell] - top[cell]) / 2) / scale
        self._cx, self._cy = min(max(cx, 0), width), min(max(cy, 0), height)
        self._w = min(max(self._w + rate * (float(w[cell]) / scale - self._w), _SMALLEST), width)
        self._h = min(max(self._h + rate * (float(h[cell]) / scale - self._h), _SMALLEST), height)
        box = (self._cx - self._w / 2, self._cy - self._h / 2, self._w, self._h)
        return Track(box, float(scores[cell]))

    def close(self) -> None:
        """Release nothing: onnxruntime's sessions end with this object."""

    def _penalty(self, w: NDArray[np.float64], h: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
        """Return the penalty of each cell for its change of scale and aspect ratio (SiamRPN, section 4.3)."""
        pad = (w + h) / 2
        sizes = np.sqrt((w + pad) * (h + pad)) / context_side(self._w * scale, self._h * scale)
        ratios = (self._w / self._h) / (w / h)
        change = np.maximum(sizes, 1 / sizes) * np.maximum(ratios, 1 / ratios)
        return np.exp((1 - change) * self._constants.penalty_k)

    def _features(self, frame: Image, side: float, size: int) -> Any:
        crop = _crop(frame, self._cx, self._cy, round(side), size, self._fill)
        planes = crop.transpose(2, 0, 1)[None].astype(np.float32)
        return self._backbone.run(None, {self._backbone.get_inputs()[0].name: planes})[0]

    def _run_head(self, features: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return scores ``(N, N)`` of the target and distances ``(4, N, N)`` to the left, top, right and bottom."""
        template, search = (entry.name for entry in self._head.get_inputs())
        logits, sizes = self._head.run(None, {template: self._template, search: features})
        scores = 1 / (1 + np.exp(logits[0, 0].astype(np.float64) - logits[0, 1]))
        return scores, sizes[0].astype(np.float64)

    def _check(self, backbone: Path, head: Path) -> None:
        """Run both networks once, so that files that do not belong together are found now."""
        frame = np.zeros((_SEARCH, _SEARCH, 3), np.uint8)
        try:
            self.init(frame, (100, 100, 50, 50))
            scores, sizes = self._run_head(self._features(frame, _SEARCH, _SEARCH))
        except Exception as error:  # onnxruntime's errors have no common base of their own
            text = f"{backbone} and {head} are not the backbone and head of one NanoTrack"
            raise UserError(f"{text} ({' '.join(str(error).split())[:120]})") from None
        cells = self._constants.cells
        if scores.shape != (cells, cells) or sizes.shape != (4, cells, cells):
            raise UserError(f"{head} has {scores.shape[-1]} cells and {self._version} has {cells}: another version?")
        self._template = None


def _any_size(model: bytes, path: Path) -> bytes:
    """Return a backbone whose input may have any side."""
    if model.count(_FIXED_INPUT) != 1:
        raise UserError(f"{path} is no NanoTrack backbone: its input is not 3x255x255")
    return model.replace(_FIXED_INPUT, _FREE_INPUT)


def _open(model: bytes, path: Path, threads: int | None) -> Any:
    try:
        return open_session(model, threads)
    except Exception as error:  # onnxruntime's errors have no common base of their own
        raise UserError(f"{path} cannot be opened ({' '.join(str(error).split())[:120]}): fetch it again") from None


def _crop(frame: Image, cx: float, cy: float, side: int, size: int, fill: tuple[int, ...]) -> Image:
    """Return the square of whole pixels about a centre, resized; outside of the frame it has the fill colour."""
    height, width = frame.shape[:2]
    left, top = (math.floor(value - (side + 1) / 2 + 0.5) for value in (cx, cy))
    square = np.empty((side, side, 3), np.uint8)
    square[:] = fill
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(left + side, width), min(top + side, height)
    if x0 < x1 and y0 < y1:
        square[y0 - top : y1 - top, x0 - left : x1 - left] = frame[y0:y1, x0:x1]
    return np.asarray(cv2.resize(square, (size, size)), np.uint8) if side != size else square
