"""The figures of a comparison as tables and CSV."""

from __future__ import annotations

import csv
import io
from itertools import combinations
from typing import Any

import numpy as np

from psiamfcpp.evaluation.differences import FEW, Difference, paired_difference
from psiamfcpp.evaluation.measured import CONVENTIONS, Measured
from psiamfcpp.evaluation.metrics import Convention
from psiamfcpp.report.compare import PAPER, Comparison
from psiamfcpp.report.layout import Cell, Row, Table, number, ranks, without_empty_columns

FIGURES = ("precision", "normalized_precision", "auc", "success50")
TITLES = dict(zip(FIGURES, ("Precision", "Norm. precision", "AUC", "Success@0.5"), strict=True))


def rows(comparison: Comparison, convention: Convention) -> list[dict[str, Any]]:
    """Return a row per tracker: those that were run or scored by precision, then those that the paper printed.

    Published rows of which nobody says what convention they follow come under both, and say so.
    """
    measured = [_measured_row(comparison, entry, convention) for entry in comparison.measured]
    measured.sort(key=lambda row: -row["precision"])
    printed = [
        {
            **_empty(comparison, row.tracker, convention),
            "kind": "published",
            "source": f"{PAPER}, {row.source.partition(',')[0]}" + ("" if row.convention else "; convention unknown"),
            "precision": row.precision,
            "fps": row.fps_cpu,
            "fps_gpu": row.fps_gpu,
        }
        for row in comparison.published
        if row.convention in (convention, None)
    ]
    return [*measured, *printed]


def speed_columns(listed: list[dict[str, Any]]) -> dict[str, str]:
    """Titles of the columns of speed, by key; that of GPUs only where a row has one, as published rows may."""
    gpu = any(row["fps_gpu"] is not None for row in listed)
    return {"fps": "FPS (CPU)"} | ({"fps_gpu": "FPS (GPU)"} if gpu else {})


def by_attribute(comparison: Comparison, entry: Measured, convention: Convention) -> dict[str, dict[str, float]]:
    """Mean figures over the sequences of each attribute; attributes of which the tracker has no sequence are absent."""
    found = {}
    for attribute, names in comparison.attributes.items():
        figures = [entry.figures[convention][name] for name in names if name in entry.files]
        if figures:
            found[attribute] = {key: float(np.mean([f[key] for f in figures])) for key in FIGURES}
    return found


def figures_table(comparison: Comparison, convention: Convention, percent: bool = False) -> Table:
    """Return the figures of all trackers, without columns in which nothing stands.

    Args:
        comparison: a benchmark with its trackers.
        convention: what rows without a valid label count for.
        percent: show shares as percent.
    """
    listed = rows(comparison, convention)
    speeds = speed_columns(listed)
    keys = TITLES | speeds
    marks = {key: ranks([None if row["kind"] == "published" else row[key] for row in listed]) for key in keys}
    lines = []
    for i, row in enumerate(listed):
        cells = [share(row[key], percent, marks[key][i]) for key in TITLES]
        cells += [number(row[key], marks[key][i], 1) for key in speeds]
        lines.append(Row(row["tracker"], [*cells, Cell(row["source"])], row["kind"]))
    elsewhere = sum(row.convention not in (convention, None) for row in comparison.published)
    note = f" {elsewhere} published rows follow the other convention, and are shown with it." if elsewhere else ""
    caption = f"{comparison.title}, convention {convention}{', percent' if percent else ''}.{note}"
    columns = ["Tracker", *keys.values(), "Source"]
    return without_empty_columns(Table(caption, columns, lines, prose=["Source"]))


def attribute_table(comparison: Comparison, convention: Convention, percent: bool = False) -> Table:
    """Return the AUC of each tracker over the sequences of each attribute, whose number stands in brackets."""
    found = {entry.tracker: by_attribute(comparison, entry, convention) for entry in comparison.measured}
    lines = []
    for name, of in comparison.attributes.items():
        if not of:
            continue
        values = [figures[name]["auc"] if name in figures else None for figures in found.values()]
        marks = ranks(values)
        cells = [share(value, percent, mark) for value, mark in zip(values, marks, strict=True)]
        lines.append(Row(f"{name} ({len(of)})", cells))
    caption = f"AUC by attribute on {comparison.title}, convention {convention}{', percent' if percent else ''}."
    return Table(caption, ["Attribute", *found], lines)


def difference_table(comparison: Comparison, convention: Convention) -> Table:
    """Return by how much the most precise tracker exceeds each other one, with intervals over sequences."""
    best, *others = sorted(comparison.measured, key=lambda entry: -entry.mean[convention].figures["precision"])
    count = len(comparison.sequences)
    caption = f"Points by which {best.tracker} exceeds the others on {comparison.title}, convention {convention}, with "
    caption += "bootstrap intervals of 95 percent over sequences. Where an interval holds 0, no difference is shown."
    if count < FEW:
        caption += f" {count} sequences are too few for intervals: these differences mean nothing by themselves."
    elif len(others) > 1:
        caption += " Each interval stands by itself, and one in twenty misses by chance."
    lines = []
    for other in others:
        found = [d for figure in ("precision", "auc") if (d := difference(best, other, convention, figure))]
        cells = [text for d in found for text in (Cell(_interval(d)), Cell(d.verdict))]
        lines += [Row(other.tracker, cells)] if cells else []
    columns = ["Compared with", "Points", "Verdict", "Points", "Verdict"]
    return Table(caption, columns, lines, groups=[("Precision", 2), ("AUC", 2)], prose=["Verdict"])


def difference(first: Measured, second: Measured, convention: Convention, figure: str) -> Difference | None:
    """Return by how much a tracker exceeds another in a figure; None where they have no sequence in common."""
    one, other = (
        {name: figures[figure] for name, figures in entry.figures[convention].items()} for entry in (first, second)
    )
    return paired_difference(one, other) if one.keys() & other.keys() else None


def differences_csv(comparisons: list[Comparison]) -> str:
    """Return a row per benchmark, convention, figure and pair of trackers."""
    return _csv(
        [
            {"dataset": c.dataset, "convention": kind, "figure": figure, "tracker": first.tracker,
             "less": second.tracker, "difference": d.mean, "low": d.low, "high": d.high, "sequences": d.sequences,
             "verdict": d.verdict}
            for c in comparisons
            for kind in CONVENTIONS
            for figure in ("precision", "auc")
            for first, second in combinations(c.measured, 2)
            if (d := difference(first, second, kind, figure))
        ]
    )  # fmt: skip


def share(value: float | None, percent: bool = False, rank: str = "") -> Cell:
    """Return a share as a cell: a fraction of three digits, or percent of one."""
    return number(None if value is None else 100 * value, rank, 1) if percent else number(value, rank)


def figures_csv(comparisons: list[Comparison]) -> str:
    """Every row of every table."""
    return _csv([row for c in comparisons for kind in CONVENTIONS for row in rows(c, kind)])


def sequences_csv(comparisons: list[Comparison]) -> str:
    """Return one row per benchmark, convention, tracker and sequence."""
    return _csv(
        [
            {"dataset": c.dataset, "convention": kind, "tracker": entry.tracker, "sequence": name, **figures}
            for c in comparisons
            for kind in CONVENTIONS
            for entry in c.measured
            for name, figures in entry.figures[kind].items()
        ]
    )


def attributes_csv(comparisons: list[Comparison]) -> str:
    """Return one row per benchmark, convention, tracker and attribute."""
    return _csv(
        [
            {
                "dataset": c.dataset,
                "convention": kind,
                "tracker": entry.tracker,
                "attribute": attribute,
                "sequences": sum(name in entry.files for name in c.attributes[attribute]),
                **figures,
            }
            for c in comparisons
            for kind in CONVENTIONS
            for entry in c.measured
            for attribute, figures in by_attribute(c, entry, kind).items()
        ]
    )


def _measured_row(comparison: Comparison, entry: Measured, convention: Convention) -> dict[str, Any]:
    known, empty = entry.row(convention), _empty(comparison, entry.tracker, convention)
    shown = {key: known.get(key, value) for key, value in empty.items()}
    kind = "measured" if entry.run else "scored"
    return {**shown, "kind": kind, "source": entry.source, "sequences": len(entry.files)}


def _interval(found: Difference) -> str:
    return f"{100 * found.mean:+.1f} [{100 * found.low:+.1f}, {100 * found.high:+.1f}]"


def _empty(comparison: Comparison, tracker: str, convention: Convention) -> dict[str, Any]:
    row: dict[str, Any] = {"dataset": comparison.dataset, "convention": convention, "tracker": tracker}
    rest = ("invalid_rows", "sequences", "missing_sequences", "fps", "fps_mean", "fps_gpu")
    return {**row, "kind": "", "source": "", **dict.fromkeys((*FIGURES, *rest))}


def _csv(listed: list[dict[str, Any]]) -> str:
    if not listed:
        return ""
    text = io.StringIO()
    writer = csv.DictWriter(text, listed[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in listed)
    return text.getvalue()
