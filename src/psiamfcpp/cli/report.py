"""`psiamfcpp report`."""

from __future__ import annotations

from pathlib import Path

import tyro

from psiamfcpp.cli.arguments import Output, Overwrite
from psiamfcpp.cli.output import check_new, notes
from psiamfcpp.datasets import BenchmarkName
from psiamfcpp.errors import UserError
from psiamfcpp.recipes.report import report as make_report
from psiamfcpp.watch import Watch


def report(
    results: tyro.conf.Positional[list[Path]],
    output: Output,
    dataset: tuple[BenchmarkName, ...] = (),
    annotations: tuple[Path, ...] = (),
    allow_missing: bool = False,
    percent: bool = False,
    sequences: tuple[str, ...] = (),
    overwrite: Overwrite = False,
) -> None:
    """Set trackers side by side: a page with figures, plots and frames, and its tables and plots as files.

    Args:
        results: folders that `evaluate` wrote with --results, or that others publish (see --dataset).
        output: folder to write report.html and the files beside it to.
        dataset: benchmarks that boxes of others are of; what `evaluate` wrote says so itself.
        annotations: labels of each of these benchmarks: its folder, or a plain one of SEQUENCE.txt.
        allow_missing: score a tracker on the sequences that it has, and say how many are missing.
        percent: show shares as percent instead of fractions, on the page and in LaTeX.
        sequences: show frames and overlap over time of these; by default those on which trackers differ most.
    """
    check_new([output], overwrite)
    if len(dataset) != len(annotations):
        raise UserError(f"--dataset names {len(dataset)} benchmarks, but --annotations {len(annotations)} folders")
    labels: dict[str, Path] = dict(zip(dataset, annotations, strict=True))
    page, *files = make_report(results, output, labels, allow_missing, percent, sequences, Watch(notes.print))
    print(f"{page} and {len(files)} files beside it")
