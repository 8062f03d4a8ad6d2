"""`psiamfcpp score`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from psiamfcpp.cli.output import notes, print_json
from psiamfcpp.datasets import BENCHMARKS, BenchmarkName
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.metrics import Convention
from psiamfcpp.evaluation.results import Files, find, score_results
from psiamfcpp.evaluation.table import result_row

_BOTH: tuple[Convention, ...] = ("otb", "got10k")
_COUNTS_FOR = {"otb": "count as precision hits and overlap misses", "got10k": "are dropped"}


def score(
    dataset: BenchmarkName,
    annotations: Path,
    results: list[Path],
    convention: Literal["otb", "got10k", "both"] = "both",
    allow_missing: bool = False,
    json: bool = False,
) -> None:
    """Score boxes that trackers left behind, without the frames.

    Args:
        dataset: name of the benchmark.
        annotations: its labels: the benchmark's folder, or a plain one of SEQUENCE.txt.
        results: folders of one tracker each, or of a folder a tracker.
        convention: what rows without a valid label count for.
        allow_missing: score a tracker on the sequences that it has, and say how many are missing.
        json: print one JSON object.
    """
    benchmark = BENCHMARKS[dataset]
    labels = benchmark.read_labels(annotations)
    trackers: dict[str, Files] = {}
    for folder in results:
        for name, files in find(folder, (dataset, *benchmark.folders[:1]), labels).items():
            if name in trackers:
                raise UserError(f"{folder} holds a second tracker called {name}: rename its folder")
            trackers[name] = files
    conventions = _BOTH if convention == "both" else (convention,)
    rows = []
    for name, files in trackers.items():
        if not files:
            notes.print(f"{name}: a folder without results of {dataset}, left out")
            continue
        missing = [sequence for sequence in labels if sequence not in files]
        if missing and not allow_missing:
            raise UserError(
                f"tracker {name} lacks {len(missing)} of {len(labels)} sequences, the first is {missing[0]}: "
                "add its result, or give --allow-missing"
            )
        if missing:
            notes.print(f"{name}: {len(missing)} of {len(labels)} sequences are missing and do not count")
        scores = score_results(labels, files, conventions)
        rows += [result_row(name, dataset, kind, by_name, None) for kind, by_name in scores.items()]
    if json:
        print_json({"results": rows})
        return
    size = "" if benchmark.size in (None, len(labels)) else f" of {benchmark.size}"
    print(f"{dataset}: {len(labels)}{size} sequences, {sum(map(len, labels.values()))} labels")
    for kind in conventions:
        _print_table(kind, [row for row in rows if row["convention"] == kind])


def _print_table(convention: Convention, rows: list[dict[str, Any]]) -> None:
    """One convention's figures: sequence by sequence where there is one tracker, else a line a tracker."""
    print(f"\n{convention}: rows without a valid label {_COUNTS_FOR[convention]}")
    print(f"{'tracker':30} precision  norm. precision    AUC  success@0.5  invalid rows")
    for row in rows:
        print(f"{row['tracker']:30} {_figures(row)}  {row['invalid_rows']:12}")
    if len(rows) == 1:
        for name, figures in rows[0]["sequences"].items():
            print(f"  {name:28} {_figures(figures)}")


def _figures(row: dict[str, Any]) -> str:
    widths = {"precision": 9, "normalized_precision": 15, "auc": 5, "success50": 11}
    return "  ".join(f"{row[key]:{width}.3f}" for key, width in widths.items())
