"""Evaluate a tracker from other starts: later in a sequence, and from boxes that are slightly off.

    python benchmarks/robustness.py MODEL [OTHER] --root SEQUENCES [SEQUENCES ...] [--states]

Where similar objects are near, one pass from the first frame depends on chance. So each sequence is followed once from
its first box, and seven times more: three times whole, twice from a quarter on and twice from the half. Place and sides
of these seven boxes are off by up to 5 % (a short form of the temporal and spatial robustness evaluation of Wu et al.
2013). The starts are the same for every model. Prints precision/AUC of each sequence in the `otb` convention: of the
single pass, of the seven in the mean, and of each. Below stand the means over sequences with 95 % bootstrap intervals,
sequences drawn with replacement; for two models, also the second less the first, sequence by sequence.
"""

from __future__ import annotations

import dataclasses
import sys
import zlib
from pathlib import Path

import numpy as np
import tyro

from psiamfcpp import datasets
from psiamfcpp.datasets import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.metrics import score_sequence
from psiamfcpp.evaluation.ope import first_label, one_pass
from psiamfcpp.geometry import FloatArray
from psiamfcpp.trackers import Tracker, TrackerOptions, open_tracker

_BEGIN = (0, 0, 0, 0.25, 0.25, 0.5, 0.5)
_OFF = 0.05
_RESAMPLES = 10_000


def main(
    models: tyro.conf.Positional[tuple[str, ...]],
    root: tuple[Path, ...],
    states: bool = False,
    threads: int = 1,
    engine: str | None = None,
) -> None:
    """Follow and print.

    Args:
        models: one tracker, or two to compare, as for `psiamfcpp evaluate --tracker`.
        root: folders of sequences; all count alike.
        states: our models follow with states, as by default elsewhere; without it, by the plain procedure.
        threads: threads of a tracker.
        engine: what runs our models; by default onnxruntime where there are graphs of them.
    """
    if not 1 <= len(models) <= 2:
        raise UserError(f"{len(models)} models given: one, or two to compare, are expected")
    sequences = [sequence for folder in root for sequence in datasets.read("folder", folder)]
    found = []
    for model in models:
        print(f"{model}, {'with states' if states else 'plain'}: single pass, mean of seven, each of the seven")
        tracker = open_tracker(model, TrackerOptions(engine, threads=threads, plain=not states))
        figures = np.array([_followed(tracker, sequence) for sequence in sequences])
        found.append(figures)
        _print_means("mean", figures)
    if len(found) == 2:
        _print_means("second - first", found[1] - found[0])


def _followed(tracker: Tracker, sequence: Sequence) -> FloatArray:
    """Return and print precision and AUC of the single pass and of the seven, ``(2, 2)``."""
    rng = np.random.default_rng(zlib.crc32(sequence.name.encode()))
    single = _score(tracker, sequence, 0.0, None)
    passes = [_score(tracker, sequence, begin, rng) for begin in _BEGIN]
    mean = np.mean(passes, axis=0)
    print(f"{sequence.name:16} {_text(single)}  {_text(mean)}   " + "  ".join(map(_text, passes)), flush=True)
    return np.array([single, mean])


def _score(tracker: Tracker, sequence: Sequence, begin: float, rng: np.random.Generator | None) -> tuple[float, float]:
    """Return precision and AUC from a share of the sequence on; without a generator, from the label itself."""
    sequence = _from(sequence, int(begin * len(sequence)))
    sequence = _from(sequence, first_label(sequence))
    given = sequence.boxes.copy()
    if rng is not None:
        given[0, :2] += rng.uniform(-_OFF, _OFF, 2) * given[0, 2:]
        given[0, 2:] *= np.exp(rng.uniform(-_OFF, _OFF, 2))
    boxes = one_pass(tracker, dataclasses.replace(sequence, boxes=given)).boxes
    figures = score_sequence(sequence.boxes, boxes).figures
    return figures["precision"], figures["auc"]


def _from(sequence: Sequence, start: int) -> Sequence:
    return dataclasses.replace(sequence, frames=sequence.frames[start:], boxes=sequence.boxes[start:])


def _print_means(name: str, figures: FloatArray) -> None:
    """Print means over sequences of figures ``(n, 2, 2)`` with their intervals."""
    for row, kind in enumerate(("single pass", "seven starts")):
        parts = []
        for column, what in enumerate(("precision", "AUC")):
            low, high = interval(figures[:, row, column])
            parts.append(f"{what} {figures[:, row, column].mean():.3f} [{low:.3f}, {high:.3f}]")
        print(f"{name}, {kind}: " + ", ".join(parts), flush=True)


def interval(figures: FloatArray) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of the mean of ``(n,)`` figures; the same figures give the same interval."""
    drawn = np.random.default_rng(0).integers(len(figures), size=(_RESAMPLES, len(figures)))
    low, high = np.percentile(figures[drawn].mean(axis=1), [2.5, 97.5])
    return float(low), float(high)


def _text(figures: tuple[float, float] | FloatArray) -> str:
    return f"{figures[0]:.3f}/{figures[1]:.3f}"


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except UserError as error:
        print(f"robustness.py: {error}", file=sys.stderr)
        sys.exit(2)
