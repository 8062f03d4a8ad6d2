"""Writes the paper's tables and figures, ours beside them, as one page with files beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.measured import CONVENTIONS, Measured
from psiamfcpp.files import write_whole
from psiamfcpp.report import plots
from psiamfcpp.report.compare import Comparison
from psiamfcpp.report.layout import Table, as_csv, as_latex
from psiamfcpp.report.page import data_address, render
from psiamfcpp.report.published import published
from psiamfcpp.report.reproduction import FIGURE_3, PRUNED, Reproduction, conditions, gains_table, paper_name
from psiamfcpp.report.strips import Strip, make_strip
from psiamfcpp.report.writing import jpeg, shown_strip

PAGE = "reproduce.html"
_TITLE = "Rank-based filter pruning for UAV tracking: the paper's tables and figures, and ours"
_KINDS: tuple[Literal["precision", "success"], ...] = ("precision", "success")


def write_reproduction(
    found: Reproduction, tables: Mapping[int, Table], there: Table, problems: Sequence[str], output: Path
) -> list[Path]:
    """Write ``reproduce.html`` and, beside it, tables as LaTeX and CSV, plots as PDF, PNG and SVG, and strips.

    Args:
        found: what there is to set beside the paper.
        tables: the paper's tables by number, as `psiamfcpp.report.reproduction.tables` makes them.
        there: a table of the benchmarks that were found.
        problems: lines about what could not be run.
        output: folder; files of the same names are replaced.

    Returns:
        The files, the page first.

    Raises:
        UserError: a file cannot be written.
    """
    files: dict[str, bytes | str] = {}
    for number, table in tables.items():
        files[f"table{number}.csv"] = as_csv(table)
        files[f"table{number}.tex"] = as_latex(table, f"reproduced-{number}")
    files["tables.tex"] = latex_document([str(files[f"table{number}.tex"]) for number in tables])
    svgs: dict[str, bytes] = {}
    styles = plots.colours(list(found.comparisons))
    for c in found.comparisons:
        for kind in CONVENTIONS:
            for what in _KINDS:
                name = f"{what}-{c.dataset}-{kind}"
                drawn = plots.as_files(plots.curves(c, what, kind, styles))
                svgs[name] = drawn["svg"]
                files |= {f"fig2-{name}.{suffix}": content for suffix, content in drawn.items()}
    strips, without = _figure_3(found, styles)
    files |= {f"fig3-{strip.sequence}.jpg": jpeg(strip.joined, 92) for strip in strips}
    text = render(
        "reproduce.html.j2",
        title=_TITLE,
        there=there,
        conditions=conditions(found),
        problems=problems,
        tables=tables,
        comparisons=found.comparisons,
        plots=lambda dataset, kind: [
            (what, data_address("svg+xml", svgs[f"{what}-{dataset}-{kind}"])) for what in _KINDS
        ],
        gains=gains_table(found),
        strips=[shown_strip(strip, styles) for strip in strips],
        without=without,
        files=list(files),
    )
    for name, content in files.items():
        write_whole(output / name, content)
    # Last, so that a page never lacks what it links to.
    write_whole(output / PAGE, text)
    return [output / PAGE, *(output / name for name in files)]


def _figure_3(found: Reproduction, styles: dict[str, tuple[str, str]]) -> tuple[list[Strip], list[str]]:
    """Return the strips of Fig. 3, and a line about each that cannot be made."""
    strips, without = [], []
    by_name = {c.dataset: c for c in found.comparisons}
    for dataset, name in FIGURE_3.items():
        comparison = by_name.get(dataset)
        sequence = comparison.frames().get(name) if comparison else None
        shown = [m for m in _shown(found, comparison) if name in m.files] if comparison else []
        if sequence is None or not shown:
            without.append(f"{name}: {'its frames are' if sequence is None else 'a result of it is'} not at hand.")
            continue
        try:
            strips.append(make_strip(sequence, shown, styles))
        except UserError as error:
            without.append(f"{name}: {error}.")
    return strips, without


def _shown(found: Reproduction, comparison: Comparison) -> list[Measured]:
    """Return P-SiamFC++ and the four best correlation filters of Table 1."""
    filters = {row.tracker for row in published() if row.dataset == "average"}
    best = sorted(comparison.measured, key=lambda m: -m.mean["otb"].figures["auc"])
    pruned = found.entry(PRUNED, comparison.dataset)
    others = [m for m in best if paper_name(m.tracker) in filters and not paper_name(m.tracker).endswith("FC++")]
    return [*([pruned] if pruned else []), *others[:4]]


def latex_document(tables: Sequence[str]) -> str:
    """Return a LaTeX document of tables, which compiles by itself."""
    page = r"\usepackage[a4paper,landscape,margin=2cm]{geometry}"
    head = [r"\documentclass{article}", page, r"\usepackage{booktabs,graphicx}", r"\begin{document}"]
    return "\n".join([*head, *tables, r"\end{document}", ""])
