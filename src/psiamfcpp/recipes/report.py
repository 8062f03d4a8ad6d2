"""Set trackers side by side on a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from psiamfcpp.errors import UserError
from psiamfcpp.report.compare import collect
from psiamfcpp.report.writing import write_report
from psiamfcpp.watch import QUIET, Watch


def report(
    results: Sequence[str | Path],
    output: str | Path,
    annotations: Mapping[str, str | Path] | None = None,
    allow_missing: bool = False,
    percent: bool = False,
    sequences: Sequence[str] = (),
    watch: Watch = QUIET,
) -> list[Path]:
    """Write a page with figures, plots and frames of trackers, and its tables and plots as files.

    Args:
        results: folders that `evaluate` wrote, or that others publish.
        output: folder to write report.html and the files beside it to.
        annotations: labels by benchmark, for boxes of others; what `evaluate` wrote names its own.
        allow_missing: score a tracker on the sequences that it has.
        percent: show shares as percent, on the page and in LaTeX.
        sequences: those to show frames and overlaps of; by default those on which trackers differ most.
        watch: receives one line about each tracker that lacks sequences.

    Returns:
        The files, the page first.

    Raises:
        UserError: a folder holds no result, labels are missing, or a file cannot be written.
        ModuleNotFoundError: matplotlib or jinja2 is not installed (extra ``report``).
    """
    if not results:
        raise UserError("no folder of results is named: give those that `evaluate` wrote")
    # Their absence must be said before the results are read.
    import jinja2  # noqa: F401
    import matplotlib  # noqa: F401

    labels = {name: Path(folder) for name, folder in (annotations or {}).items()}
    comparisons = collect([Path(folder) for folder in results], labels, allow_missing)
    for c in comparisons:
        for entry in c.measured:
            if entry.missing:
                count = f"{entry.missing} of {len(c.sequences)}"
                watch.note(f"{entry.tracker}: {count} sequences of {c.dataset} are missing and do not count")
    known = {name for c in comparisons for name in c.sequences}
    unknown = next((name for name in sequences if name not in known), None)
    if unknown is not None:
        raise UserError(f"sequence {unknown} is in none of the benchmarks: sequences.csv of a report lists them")
    return write_report(comparisons, Path(output), percent, sequences)
