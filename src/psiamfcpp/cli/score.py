"""`psiamfcpp score`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from psiamfcpp.cli.arguments import Json
from psiamfcpp.cli.output import notes, print_json
from psiamfcpp.datasets import BENCHMARKS, BenchmarkName
from psiamfcpp.evaluation.measured import CONVENTIONS, Measured
from psiamfcpp.evaluation.metrics import Convention
from psiamfcpp.recipes.score import score as score_results
from psiamfcpp.watch import Watch

_COUNTS_FOR = {"otb": "count as precision hits and overlap misses", "got10k": "are dropped"}


def score(
    dataset: BenchmarkName,
    annotations: Path,
    results: list[Path],
    convention: Literal["otb", "got10k", "both"] = "both",
    per_sequence: bool = False,
    allow_missing: bool = False,
    json: Json = False,
) -> None:
    """Score boxes that trackers left behind, without the frames.

    Args:
        dataset: name of the benchmark.
        annotations: its labels: the benchmark's folder, or a plain one of SEQUENCE.txt.
        results: folders of one tracker each, or folders with one folder per tracker.
        convention: what rows without a valid label count for.
        per_sequence: print each sequence's figures too, as is done for a single tracker anyway.
        allow_missing: score a tracker on the sequences that it has, and say how many are missing.
    """
    conventions = CONVENTIONS if convention == "both" else (convention,)
    measured = score_results(dataset, annotations, results, conventions, allow_missing, Watch(notes.print))
    if json:
        print_json({"results": [entry.row(kind) for entry in measured for kind in conventions]})
    else:
        print_measured(dataset, measured, conventions, per_sequence)


def print_measured(
    dataset: BenchmarkName, measured: list[Measured], conventions: tuple[Convention, ...], per_sequence: bool
) -> None:
    """Print what trackers scored: a table per convention, or one where they agree, with one line per tracker."""
    first = measured[0]
    count, official = len(first.files) + first.missing, BENCHMARKS[dataset].size
    print(
        f"{dataset}: {count}{'' if official in (None, count) else f' of {official}'} sequences, {first.labels} labels"
    )
    agree = len(conventions) > 1 and all(not entry.mean[kind].invalid for entry in measured for kind in conventions)
    for kind in conventions[: 1 if agree else None]:
        if agree:
            print(f"\n{' and '.join(conventions)} agree: every row has a valid label")
        else:
            print(f"\n{kind}: rows without a valid label {_COUNTS_FOR[kind]}")
        print(f"{'tracker':30} precision  norm. precision    AUC  success@0.5  invalid rows")
        for entry in measured:
            row = entry.row(kind)
            print(f"{entry.tracker:30} {_figures(row)}  {row['invalid_rows']:12}")
            for name, figures in row["sequences"].items() if per_sequence or len(measured) == 1 else ():
                print(f"  {name:28} {_figures(figures)}")


def _figures(row: dict[str, Any]) -> str:
    widths = {"precision": 9, "normalized_precision": 15, "auc": 5, "success50": 11}
    return "  ".join(f"{row[key]:{width}.3f}" for key, width in widths.items())
