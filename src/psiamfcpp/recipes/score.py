"""Score boxes that trackers left behind, without the frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from psiamfcpp.datasets import BENCHMARKS, BenchmarkName
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.measured import CONVENTIONS, Measured, measure
from psiamfcpp.evaluation.metrics import Convention
from psiamfcpp.evaluation.results import Files, find_all
from psiamfcpp.geometry import FloatArray
from psiamfcpp.watch import QUIET, Watch


def score(
    dataset: BenchmarkName,
    annotations: Path,
    results: Sequence[Path],
    conventions: Sequence[Convention] = CONVENTIONS,
    allow_missing: bool = False,
    watch: Watch = QUIET,
) -> list[Measured]:
    """Score every tracker in folders of results.

    Args:
        dataset: name of the benchmark.
        annotations: its labels: the benchmark's folder, or a plain one of SEQUENCE.txt.
        results: folders of one tracker each, or folders with one folder per tracker.
        conventions: what rows without a valid label count for.
        allow_missing: score a tracker on the sequences that it has.
        watch: receives one line about each tracker that is left out or lacks sequences.

    Returns:
        One entry per tracker that has results.

    Raises:
        UserError: a folder or its labels cannot be read, a sequence is missing, or a result does not fit its labels.
    """
    if not results:
        raise UserError("--results names no folder: give those of the trackers")
    benchmark = BENCHMARKS[dataset]
    labels = benchmark.read_labels(annotations)
    trackers = find_all(list(results), (dataset, *benchmark.folders[:1]), labels)
    return measure_all(dataset, labels, trackers, conventions, allow_missing, watch)


def measure_all(
    dataset: str,
    labels: dict[str, FloatArray],
    trackers: dict[str, Files],
    conventions: Sequence[Convention],
    allow_missing: bool,
    watch: Watch,
) -> list[Measured]:
    """Score result files of several trackers; arguments and errors as of `score`."""
    found = []
    for name, files in trackers.items():
        if not files:
            watch.note(f"{name}: a folder without results of {dataset}, left out")
            continue
        entry = measure(name, dataset, files, labels, conventions, allow_missing)
        if entry.missing:
            watch.note(f"{name}: {entry.missing} of {len(labels)} sequences are missing and do not count")
        found.append(entry)
    return found
