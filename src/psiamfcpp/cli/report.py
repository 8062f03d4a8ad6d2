"""`psiamfcpp report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from psiamfcpp.cli.output import notes
from psiamfcpp.datasets import BenchmarkName
from psiamfcpp.errors import UserError
from psiamfcpp.report.compare import collect
from psiamfcpp.report.writing import write_report


def report(
    results: Annotated[list[Path], tyro.conf.Positional],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    dataset: tuple[BenchmarkName, ...] = (),
    annotations: tuple[Path, ...] = (),
    allow_missing: bool = False,
) -> None:
    """Set trackers side by side: a page with figures, plots and frames, and its tables and plots as files.

    Args:
        results: folders that `evaluate` wrote with --results, or that others publish (see --dataset).
        output: folder to write report.html and the files beside it to.
        dataset: benchmarks that boxes of others are of; what `evaluate` wrote says so itself.
        annotations: labels of each of these benchmarks: its folder, or a plain one of SEQUENCE.txt.
        allow_missing: score a tracker on the sequences that it has, and say how many are missing.
    """
    if not results:
        raise UserError("no folder of results is named: give those that `evaluate` wrote")
    if len(dataset) != len(annotations):
        raise UserError(f"--dataset names {len(dataset)} benchmarks, but --annotations {len(annotations)} folders")
    import matplotlib  # noqa: F401 - its absence must be said before the results are read

    comparisons = collect(results, dict(zip(dataset, annotations, strict=True)), allow_missing)
    for c in comparisons:
        for entry in c.measured:
            if entry.missing:
                count = f"{entry.missing} of {len(c.sequences)}"
                notes.print(f"{entry.tracker}: {count} sequences of {c.dataset} are missing and do not count")
    page, *files = write_report(comparisons, output)
    print(f"{page} and {len(files)} files beside it")
