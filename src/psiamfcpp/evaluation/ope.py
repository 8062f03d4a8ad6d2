"""One pass of a tracker over a sequence, with its time, or over many for their mean scores."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from psiamfcpp.datasets import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.metrics import Scores, mean_scores, score_sequence
from psiamfcpp.geometry import FloatArray
from psiamfcpp.images import ImageReader
from psiamfcpp.trackers.contract import Tracker


@dataclass(frozen=True)
class Pass:
    """What a tracker made of a sequence."""

    boxes: FloatArray
    """``(n, 4)``: NaN before the first label, the label itself where the tracker began, then the tracker's boxes"""
    seconds: FloatArray
    """``(n,)``: time of init or update, decoding apart; NaN before the first label"""
    decoding: FloatArray
    """``(n,)``: time to read and decode the frame; NaN before the first label"""


def first_label(sequence: Sequence) -> int:
    """The first frame with a label to begin with: four finite numbers, and a width and a height above 0.

    Raises:
        UserError: there is none.
    """
    usable = sequence.usable()
    if not len(usable):
        raise UserError("no label is a box that a tracker can begin with: fix the labels")
    return int(usable[0])


def one_pass(tracker: Tracker, sequence: Sequence) -> Pass:
    """Run a tracker from the first label to the last frame (one-pass evaluation).

    Raises:
        UserError: a frame cannot be read, there is no label to begin with, or the tracker refuses.
    """
    start = first_label(sequence)
    boxes = np.full((len(sequence), 4), np.nan)
    seconds, decoding = np.full(len(sequence), np.nan), np.full(len(sequence), np.nan)
    boxes[start] = sequence.boxes[start]
    images = ImageReader()
    for i in range(start, len(sequence)):
        begin = time.perf_counter()
        frame = sequence.frame(i, images)
        decoded = time.perf_counter()
        if i == start:
            tracker.init(frame, sequence.boxes[i])
        else:
            boxes[i] = tracker.update(frame).box
        seconds[i], decoding[i] = time.perf_counter() - decoded, decoded - begin
    return Pass(boxes, seconds, decoding)


def mean_over(tracker: Tracker, sequences: Iterable[Sequence]) -> Scores:
    """Mean scores of one pass over each sequence, in the `otb` convention.

    Raises:
        UserError: see `one_pass`.
    """
    return mean_scores(score_sequence(s.boxes, one_pass(tracker, s).boxes) for s in sequences)
