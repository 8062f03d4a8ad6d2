"""One pass of a tracker over a sequence, with its time."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from psiamfcpp.datasets import Sequence
from psiamfcpp.geometry import FloatArray
from psiamfcpp.images import read_image
from psiamfcpp.tracking import Tracker
from psiamfcpp.tracking.confidence import State


@dataclass(frozen=True)
class Pass:
    """What a tracker made of a sequence."""

    boxes: FloatArray
    """``(n, 4)``; the first is the label that it began with"""
    scores: FloatArray
    """``(n,)``"""
    states: list[State]
    """one a frame"""
    seconds: FloatArray
    """``(n,)``: time of init or update, decoding apart"""


def one_pass(tracker: Tracker, sequence: Sequence) -> Pass:
    """Run a tracker from the first label to the last frame (one-pass evaluation).

    Raises:
        UserError: a frame cannot be read.
    """
    tracks, seconds = [], []
    for i, path in enumerate(sequence.frames):
        frame = read_image(path)
        start = time.perf_counter()
        track = tracker.init(frame, sequence.boxes[0]) if i == 0 else tracker.update(frame)
        seconds.append(time.perf_counter() - start)
        tracks.append(track)
    boxes, scores = np.array([t.box for t in tracks]), np.array([t.score for t in tracks])
    return Pass(boxes, scores, [t.state for t in tracks], np.array(seconds))
