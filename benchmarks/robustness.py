"""How a tracker fares when it begins elsewhere: later in a sequence, and from boxes that are slightly off.

    python benchmarks/robustness.py MODEL --root SEQUENCES

One pass from the first frame turns on chance where look-alikes are near. So each sequence is followed seven times,
three times whole, twice from a quarter on and twice from the half, each from a box whose place and sides are off by up
to 5 % (a short form of the temporal and spatial robustness evaluation of Wu et al. 2013). Prints precision/AUC of each
sequence, of its passes and in the mean, in the `otb` convention.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import tyro

from psiamfcpp import datasets
from psiamfcpp.datasets import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.metrics import score_sequence
from psiamfcpp.evaluation.ope import first_label, one_pass
from psiamfcpp.trackers import Tracker, TrackerOptions, open_tracker

_BEGIN = (0, 0, 0, 0.25, 0.25, 0.5, 0.5)
_OFF = 0.05


def main(model: tyro.conf.Positional[str], root: Path, threads: int = 1, engine: str | None = None) -> None:
    """Follow and print.

    Args:
        model: a tracker, as for `psiamfcpp evaluate --tracker`; our models follow with the plain procedure.
        root: folder of sequences.
        threads: threads of the tracker.
        engine: what runs our model; by default onnxruntime where there are graphs of it.
    """
    tracker = open_tracker(model, TrackerOptions(engine, threads=threads, plain=True))
    rng = np.random.default_rng(0)
    means = []
    for sequence in datasets.read("folder", root):
        passes = [_score(tracker, sequence, begin, rng) for begin in _BEGIN]
        means.append(np.mean(passes, axis=0))
        print(f"{sequence.name:16} {_text(means[-1])}   " + "  ".join(map(_text, passes)), flush=True)
    print(f"{'mean':16} {_text(np.mean(means, axis=0))}")


def _score(tracker: Tracker, sequence: Sequence, begin: float, rng: np.random.Generator) -> tuple[float, float]:
    """Precision and AUC from a share of the sequence on."""
    start = int(begin * len(sequence))
    frames, truth = sequence.frames[start:], sequence.boxes[start:]
    start = first_label(dataclasses.replace(sequence, frames=frames, boxes=truth))
    frames, truth = frames[start:], truth[start:]
    given = truth.copy()
    given[0, :2] += rng.uniform(-_OFF, _OFF, 2) * given[0, 2:]
    given[0, 2:] *= np.exp(rng.uniform(-_OFF, _OFF, 2))
    boxes = one_pass(tracker, dataclasses.replace(sequence, frames=frames, boxes=given)).boxes
    figures = score_sequence(truth, boxes).figures
    return figures["precision"], figures["auc"]


def _text(figures: tuple[float, float] | np.ndarray) -> str:
    return f"{figures[0]:.3f}/{figures[1]:.3f}"


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except UserError as error:
        print(f"robustness.py: {error}", file=sys.stderr)
        sys.exit(2)
