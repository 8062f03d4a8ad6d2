"""A table as data: what the page, a paper and a terminal show of it is the same."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

NONE = "\u2013"
_RANKS = ("first", "second", "third")
# A table of more columns than this is scaled down to the width of the page.
_WIDE = 8
_REMARKS = ("Source", "Remark")
_LATEX = {
    "\\": r"\textbackslash{}",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    NONE: "--",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
}
_MARKS = {"published": r"$^\dagger$", "scored": r"$^\ddagger$"}
_SAID = {"published": r"$\dagger$: as published, not measured.", "scored": r"$\ddagger$: scored from boxes of others."}


class Cell(NamedTuple):
    """What stands in one place."""

    text: str
    rank: str = ""
    """first, second or third of its column"""
    heat: str = ""
    """0..1 where the place is shaded by its figure"""


class Row(NamedTuple):
    """One line."""

    name: str
    cells: Sequence[Cell]
    kind: str = ""
    """measured, scored or published; shown beside the name"""


@dataclass(frozen=True)
class Table:
    """Rows under titles."""

    caption: str
    columns: Sequence[str]
    """titles, that of the names first"""
    rows: Sequence[Row]
    groups: Sequence[tuple[str, int]] = ()
    """titles over several columns, with their number; the names have none"""
    prose: Sequence[str] = ()
    """columns of text, which is set to the left"""


def number(value: float | None, rank: str = "", digits: int = 3) -> Cell:
    """Return a figure as a cell; a dash where there is none."""
    return Cell(NONE if value is None else f"{value:.{digits}f}", rank)


def ranks(values: Sequence[float | None]) -> list[str]:
    """Return the rank of each value: of the three highest, where there is anything to rank."""
    known = sorted({round(v, 6) for v in values if v is not None}, reverse=True)[: len(_RANKS)]
    found = dict(zip(known, _RANKS, strict=False)) if len(known) > 1 else {}
    return ["" if v is None else found.get(round(v, 6), "") for v in values]


def without_empty_columns(table: Table) -> Table:
    """Return a table without the columns in which nothing stands."""
    kept = [i for i in range(len(table.columns) - 1) if any(row.cells[i].text not in ("", NONE) for row in table.rows)]
    spans, start = [], 0
    for title, width in table.groups:
        spans.append((title, sum(start <= i < start + width for i in kept)))
        start += width
    return replace(
        table,
        columns=[table.columns[0], *(table.columns[i + 1] for i in kept)],
        rows=[row._replace(cells=[row.cells[i] for i in kept]) for row in table.rows],
        groups=[span for span in spans if span[1]],
    )


def as_latex(table: Table, label: str) -> str:
    """Return a table for a paper, without empty columns; the best of each ranked column is bold.

    Args:
        table: what to show; a last column of sources or remarks becomes comments.
        label: what a paper refers to it by, without its ``tab:``.
    """
    rows, notes = table.rows, [""] * len(table.rows)
    if table.columns[-1] in _REMARKS:
        notes = [row.cells[-1].text for row in rows]
        rows = [row._replace(cells=[*row.cells[:-1], Cell("")]) for row in rows]
    shown = without_empty_columns(replace(table, rows=rows))
    wide = len(shown.columns) > _WIDE
    packages = r"\usepackage{booktabs}" + (r" and \usepackage{graphicx}" if wide else "")
    kinds = {row.kind for row in shown.rows}
    # LaTeX numbers tables itself.
    caption = re.sub(r"^Table \d+\. ", "", table.caption)
    said = [text for kind, text in _SAID.items() if kind in kinds]
    lines = [
        f"% needs {packages} in the preamble",
        rf"\begin{{table{'*' * wide}}}",
        r"\centering",
        rf"\caption{{{' '.join([escape(caption), *said])}}}",
        rf"\label{{tab:{label}}}",
        *([r"\resizebox{\textwidth}{!}{%"] if wide else []),
        rf"\begin{{tabular}}{{l{''.join('l' if title in table.prose else 'r' for title in shown.columns[1:])}}}",
        r"\toprule",
        *_group_lines(shown),
        " & ".join(map(escape, shown.columns)) + r" \\",
        r"\midrule",
    ]
    for i, (row, note) in enumerate(zip(shown.rows, notes, strict=True)):
        if i and row.kind == "published" and shown.rows[i - 1].kind not in ("published", ""):
            lines.append(r"\midrule")
        cells = [rf"\textbf{{{escape(c.text)}}}" if c.rank == "first" else escape(c.text) for c in row.cells]
        comment = f" % {' '.join(note.split())}" if note.strip() else ""
        lines.append(" & ".join([escape(row.name) + _MARKS.get(row.kind, ""), *cells]) + r" \\" + comment)
    end = r"\end{tabular}" + ("}" if wide else "")
    return "\n".join([*lines, r"\bottomrule", end, rf"\end{{table{'*' * wide}}}", ""])


def as_csv(table: Table) -> str:
    """Return a table as CSV; titles of groups stand before those of their columns."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    titles = [table.columns[0], "kind", *table.columns[1:]]
    if table.groups:
        over = ["", "", *(title for title, width in table.groups for _ in range(width))]
        titles = [" ".join(filter(None, pair)) for pair in zip(over, titles, strict=True)]
    writer.writerow(titles)
    writer.writerows([row.name, row.kind, *(c.text.replace(NONE, "") for c in row.cells)] for row in table.rows)
    return text.getvalue()


def as_text(table: Table) -> str:
    """Return a table for a terminal."""
    lines = [list(table.columns)]
    for row in table.rows:
        lines.append([f"{row.name} ({row.kind})" if row.kind else row.name, *(cell.text for cell in row.cells)])
    if table.groups:
        over = [""]
        for title, width in table.groups:
            over += [title, *[""] * (width - 1)]
        lines.insert(0, over)
    widths = [max(len(line[i]) for line in lines) for i in range(len(table.columns))]
    left = {0, *(i for i, title in enumerate(table.columns) if title in table.prose)}
    shown = [
        "  ".join(text.ljust(widths[i]) if i in left else text.rjust(widths[i]) for i, text in enumerate(line)).rstrip()
        for line in lines
    ]
    return "\n".join([table.caption, *shown])


def escape(text: str) -> str:
    """Return text for LaTeX."""
    return "".join(_LATEX.get(sign, sign) for sign in text)


def _group_lines(table: Table) -> list[str]:
    if not table.groups:
        return []
    titles, rules, start = [""], [], 2
    for title, width in table.groups:
        titles += [rf"\multicolumn{{{width}}}{{c}}{{{escape(title)}}}"] if title else [""] * width
        rules += [rf"\cmidrule(lr){{{start}-{start + width - 1}}}"] if title else []
        start += width
    return [" & ".join(titles) + r" \\", "".join(rules)]
