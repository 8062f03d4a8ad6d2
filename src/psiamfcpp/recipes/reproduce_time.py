"""Estimate how long a tracker takes for a frame."""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import numpy as np

from psiamfcpp.datasets import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.ope import first_label
from psiamfcpp.trackers import TrackerChoice

_UPDATES = 4


def seconds_per_frame(choice: TrackerChoice, sequence: Sequence, results: Path | None) -> float | None:
    """Return the seconds that a tracker takes for a frame, decoding included; None where it cannot follow.

    They are taken from its earlier runs; without any, a few frames of the sequence are followed.

    Args:
        choice: the tracker.
        sequence: one of those that are to be run.
        results: folder of results, with a folder per benchmark.

    Raises:
        UserError: the tracker cannot be opened.
    """
    earlier = _earlier(results, choice.name) if results else None
    if earlier is not None:
        return earlier
    tracker = choice.open()
    try:
        start = first_label(sequence)
        tracker.init(sequence.frame(start), sequence.boxes[start])
        taken = []
        # The first update may compile, and does not count.
        for number in range(start + 1, min(start + 2 + _UPDATES, len(sequence))):
            begin = time.perf_counter()
            tracker.update(sequence.frame(number))
            taken.append(time.perf_counter() - begin)
    except UserError:
        # The run itself will say what is wrong with the sequence.
        return None
    finally:
        tracker.close()
    return statistics.median(taken[1:] or taken or [0.0])


def _earlier(results: Path, name: str) -> float | None:
    """Return the mean time of a frame, over the sequences of any benchmark that were run."""
    rows: list[float] = []
    for path in sorted(results.glob(f"*/{name}/*_time.txt")):
        times = np.genfromtxt(path, delimiter=",", ndmin=2)
        rows += times[np.isfinite(times).all(axis=1)][1:].sum(axis=1).tolist()
    return statistics.fmean(rows) if rows else None
