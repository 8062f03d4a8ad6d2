"""Strips of frames with the boxes of several trackers, as in the paper's qualitative figure."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from psiamfcpp.datasets import Sequence as Labelled
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.measured import Measured
from psiamfcpp.geometry import FloatArray, Image
from psiamfcpp.report.compare import Comparison
from psiamfcpp.video.drawing import Colour, draw_status

_WHITE: Colour = (255, 255, 255)
_SIZE = (480, 270)
_ZOOM = 3
_SEQUENCES, _FRAMES, _TRACKERS = 3, 4, 5


@dataclass(frozen=True)
class Strip:
    """One sequence."""

    sequence: str
    trackers: list[str]
    """those that are drawn, the best first"""
    frames: dict[int, Image]
    """``(H, W, 3)`` uint8 BGR, by number in the sequence, from 1, all of one size"""

    @property
    def joined(self) -> Image:
        """The frames side by side, with their numbers and a narrow gap."""
        numbered = [draw_status(frame, [f"#{number}"]) for number, frame in self.frames.items()]
        gap = np.full((numbered[0].shape[0], 6, 3), 255, np.uint8)
        return np.hstack([part for frame in numbered for part in (frame, gap)][:-1])


def telling(comparison: Comparison, wanted: Collection[str] = (), among: Sequence[str] | None = None) -> list[str]:
    """Return the sequences that are wanted, or those on which the best trackers differ most.

    Args:
        comparison: a benchmark with its trackers.
        wanted: names, of any benchmark.
        among: names to choose from; by default all of the benchmark.
    """
    names = comparison.sequences if among is None else among
    if wanted:
        return [name for name in names if name in wanted]
    best = _best(comparison)
    return sorted(names, key=lambda name: -_spread(best, name))[:_SEQUENCES]


def strips(comparison: Comparison, styles: dict[str, tuple[str, str]], sequences: Collection[str] = ()) -> list[Strip]:
    """Return a few frames of each sequence; none where the frames are not at hand.

    Args:
        comparison: a benchmark with its trackers.
        styles: a colour (``#rrggbb``) per tracker; the label is drawn in white.
        sequences: which; by default those on which trackers differ most.
    """
    by_name = comparison.frames()
    made = []
    for name in telling(comparison, sequences, [n for n in comparison.sequences if len(by_name.get(n, ())) > 1]):
        shown = [entry for entry in _best(comparison) if name in entry.files]
        try:
            made.append(make_strip(by_name[name], shown, styles))
        except UserError:
            # An image that cannot be read costs its strip, not the report.
            continue
    return made


def _best(comparison: Comparison) -> list[Measured]:
    return sorted(comparison.measured, key=lambda entry: -entry.mean["otb"].figures["auc"])[:_TRACKERS]


def _spread(entries: list[Measured], name: str) -> float:
    overlaps = [entry.figures["otb"][name]["auc"] for entry in entries if name in entry.files]
    return max(overlaps) - min(overlaps) if overlaps else -1.0


def make_strip(sequence: Labelled, entries: list[Measured], styles: dict[str, tuple[str, str]]) -> Strip:
    """Return a strip of one sequence, with the boxes of trackers that have a result of it, the best first.

    Raises:
        UserError: a frame or a result cannot be read.
    """
    boxes = {entry.tracker: entry.boxes(sequence.name, len(sequence)) for entry in entries}
    colours = {tracker: _bgr(styles[tracker][0]) for tracker in boxes}
    frames: dict[int, Image] = {}
    for number in np.linspace(0, len(sequence) - 1, _FRAMES + 1).round().astype(int)[1:].tolist():
        # the best last, on top
        drawn = [(sequence.boxes[number], _WHITE), *((boxes[t][number], colours[t]) for t in reversed(boxes))]
        usable = [(box, colour) for box, colour in drawn if np.isfinite(box).all() and (box[2:] > 0).all()]
        frames[number + 1] = _picture(sequence.frame(number), usable)
    return Strip(sequence.name, list(boxes), frames)


def _picture(frame: Image, boxes: list[tuple[FloatArray, Colour]]) -> Image:
    """The part of a frame that holds all boxes, with them, at the size at which it is shown."""
    left, top, scale = _view(frame.shape[1], frame.shape[0], np.array([box for box, _ in boxes]).reshape(-1, 4))
    width, height = _SIZE
    # to where the frame ends; the rest stays grey
    image = cv2.warpAffine(
        frame,
        np.array([[scale, 0, -left * scale], [0, scale, -top * scale]]),
        _SIZE,
        flags=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR,
        borderValue=(128, 128, 128),
    )
    for (x, y, w, h), colour in boxes:
        # OpenCV draws no coordinate beyond 16 bits
        columns = np.clip(np.array([x - left, x + w - 1 - left]) * scale, -9, width + 9).round().astype(int).tolist()
        lines = np.clip(np.array([y - top, y + h - 1 - top]) * scale, -9, height + 9).round().astype(int).tolist()
        cv2.rectangle(image, (columns[0], lines[0]), (columns[1], lines[1]), colour, 2)
    return np.asarray(image, np.uint8)


def _view(width: int, height: int, boxes: FloatArray) -> tuple[float, float, float]:
    """Left, top and magnification of the view: all boxes with room about them, as far as the frame reaches."""
    aspect = _SIZE[0] / _SIZE[1]
    low, high = np.zeros(2), np.array([width, height], float)
    if len(boxes):
        # small targets are many: room for three more on either side
        room = 3 * boxes[:, 2:].max(axis=0)
        low = np.maximum(boxes[:, :2].min(axis=0) - room, low)
        high = np.minimum((boxes[:, :2] + boxes[:, 2:]).max(axis=0) + room, high)
    # the whole frame at most, and never magnified beyond recognition
    side = max(high[0] - low[0], (high[1] - low[1]) * aspect, _SIZE[0] / _ZOOM)
    side = min(side, max(width, height * aspect))
    middle = (low + high) / 2
    left, top = middle - np.array([side, side / aspect]) / 2
    left = min(max(left, 0.0), max(width - side, 0.0))
    top = min(max(top, 0.0), max(height - side / aspect, 0.0))
    return left, top, _SIZE[0] / side


def _bgr(colour: str) -> Colour:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return (blue, green, red)
