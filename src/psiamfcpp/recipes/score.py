"""Score boxes that trackers left behind, without the frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    annotations: str | Path,
    results: Sequence[str | Path],
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
        allow_missing: score a tracker on the sequences of which it has a result that fits.
        watch: receives one line about each tracker that is left out or lacks sequences, and about each of these.

    Returns:
        One entry per tracker that has results.

    Raises:
        UserError: a folder or its labels cannot be read, a sequence is missing, or a result does not fit its labels.
    """
    if not results:
        raise UserError("--results names no folder: give those of the trackers")
    benchmark = BENCHMARKS[dataset]
    unread: dict[str, str] = {}
    labels = benchmark.read_labels(Path(annotations), unread if allow_missing else None)
    trackers = find_all([Path(folder) for folder in results], (dataset, *benchmark.folders[:1]), labels)
    return measure_all(dataset, labels, trackers, conventions, allow_missing, watch, unread)


def measure_all(
    dataset: str,
    labels: dict[str, FloatArray],
    trackers: dict[str, Files],
    conventions: Sequence[Convention],
    allow_missing: bool,
    watch: Watch,
    unread: Mapping[str, str],
) -> list[Measured]:
    """Score result files of several trackers; arguments as of `measure`, errors as of `score`."""
    found = []
    for name, files in trackers.items():
        if not files:
            watch.note(f"{name}: a folder without results of {dataset}, left out")
            continue
        try:
            entry = measure(name, dataset, files, labels, conventions, allow_missing, unread)
        except UserError as error:
            if not allow_missing or len(trackers) == 1:
                raise
            watch.note(f"{name}, left out: {error}")
            continue
        if entry.missing:
            watch.note(f"{name}: {entry.missing} of {len(labels) + len(unread)} sequences are missing and do not count")
        for sequence, reason in entry.left_out.items():
            watch.note(f"{name} on sequence {sequence}: {reason}")
        found.append(entry)
    if not found:
        raise UserError(f"no tracker has a result of {dataset} that can be scored")
    return found
