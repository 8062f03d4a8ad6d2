"""`psiamfcpp score`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from psiamfcpp.cli.output import notes, print_json
from psiamfcpp.datasets import BENCHMARKS, BenchmarkName
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.metrics import Convention
from psiamfcpp.evaluation.results import Files, count_missing, find_all, read_speed, score_results
from psiamfcpp.evaluation.table import result_row
from psiamfcpp.geometry import FloatArray

BOTH: tuple[Convention, ...] = ("otb", "got10k")
_COUNTS_FOR = {"otb": "count as precision hits and overlap misses", "got10k": "are dropped"}


def score(
    dataset: BenchmarkName,
    annotations: Path,
    results: list[Path],
    convention: Literal["otb", "got10k", "both"] = "both",
    per_sequence: bool = False,
    allow_missing: bool = False,
    json: bool = False,
) -> None:
    """Score boxes that trackers left behind, without the frames.

    Args:
        dataset: name of the benchmark.
        annotations: its labels: the benchmark's folder, or a plain one of SEQUENCE.txt.
        results: folders of one tracker each, or of a folder a tracker.
        convention: what rows without a valid label count for.
        per_sequence: print each sequence's figures too, as is done for a single tracker anyway.
        allow_missing: score a tracker on the sequences that it has, and say how many are missing.
        json: print one JSON object.
    """
    if not results:
        raise UserError("--results names no folder: give those of the trackers")
    benchmark = BENCHMARKS[dataset]
    labels = benchmark.read_labels(annotations)
    trackers = find_all(results, (dataset, *benchmark.folders[:1]), labels)
    conventions = BOTH if convention == "both" else (convention,)
    rows = score_rows(dataset, labels, trackers, conventions, allow_missing)
    if json:
        print_json({"results": rows})
        return
    print_head(dataset, labels)
    print_tables(rows, per_sequence or sum(map(bool, trackers.values())) == 1)


def score_rows(
    dataset: BenchmarkName,
    labels: dict[str, FloatArray],
    trackers: dict[str, Files],
    conventions: Iterable[Convention],
    allow_missing: bool,
) -> list[dict[str, Any]]:
    """Figures of trackers, a row a tracker and a convention; what is left out is said on standard error.

    Raises:
        UserError: a tracker lacks a sequence without leave, or a result cannot be scored.
    """
    rows = []
    for name, files in trackers.items():
        if not files:
            notes.print(f"{name}: a folder without results of {dataset}, left out")
            continue
        missing = count_missing(name, files, labels, allow_missing)
        if missing:
            notes.print(f"{name}: {missing} of {len(labels)} sequences are missing and do not count")
        scores = score_results(labels, files, list(conventions))
        speed = read_speed(files)
        fps = None if speed is None else speed.median
        rows += [
            {**result_row(name, dataset, kind, by_name, fps), "missing_sequences": missing}
            for kind, by_name in scores.items()
        ]
    return rows


def print_head(dataset: BenchmarkName, labels: dict[str, FloatArray]) -> None:
    """What is scored; a benchmark that is there in part is said to be."""
    official = BENCHMARKS[dataset].size
    size = "" if official in (None, len(labels)) else f" of {official}"
    print(f"{dataset}: {len(labels)}{size} sequences, {sum(map(len, labels.values()))} labels")


def print_tables(rows: list[dict[str, Any]], per_sequence: bool) -> None:
    """A table a convention: a line a tracker, in the order of the rows, each followed by its sequences if wanted."""
    for kind in dict.fromkeys(row["convention"] for row in rows):
        print(f"\n{kind}: rows without a valid label {_COUNTS_FOR[kind]}")
        print(f"{'tracker':30} precision  norm. precision    AUC  success@0.5  invalid rows")
        for row in rows:
            if row["convention"] == kind:
                print(f"{row['tracker']:30} {_figures(row)}  {row['invalid_rows']:12}")
                for name, figures in row["sequences"].items() if per_sequence else ():
                    print(f"  {name:28} {_figures(figures)}")


def _figures(row: dict[str, Any]) -> str:
    widths = {"precision": 9, "normalized_precision": 15, "auc": 5, "success50": 11}
    return "  ".join(f"{row[key]:{width}.3f}" for key, width in widths.items())
