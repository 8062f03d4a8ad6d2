"""The figures of a comparison as CSV and LaTeX."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np

from psiamfcpp.evaluation.measured import CONVENTIONS, Measured
from psiamfcpp.evaluation.metrics import Convention
from psiamfcpp.report.compare import PAPER, Comparison

FIGURES = ("precision", "normalized_precision", "auc", "success50")
_LATEX = {
    "\\": r"\textbackslash{}",
    "^": r"\textasciicircum{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
}


def rows(comparison: Comparison, convention: Convention) -> list[dict[str, Any]]:
    """A row a tracker: the measured ones by precision, then those that the paper printed.

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


def figures_csv(comparisons: list[Comparison]) -> str:
    """Every row of every table."""
    return _csv([row for c in comparisons for kind in CONVENTIONS for row in rows(c, kind)])


def sequences_csv(comparisons: list[Comparison]) -> str:
    """A row a benchmark, convention, tracker and sequence."""
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
    """A row a benchmark, convention, tracker and attribute."""
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


def latex(comparison: Comparison, convention: Convention) -> str:
    """A table for a paper (needs the package booktabs); published rows bear a dagger and their source."""
    listed = rows(comparison, convention)
    speeds = speed_columns(listed)
    best = {key: max((row[key] for row in listed if row["kind"] == "measured"), default=None) for key in FIGURES}
    lines = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{_escape(comparison.title)}, convention {convention}. $\dagger$: as published, not measured.}}",
        rf"\begin{{tabular}}{{lrrrr{'r' * len(speeds)}}}",
        r"\toprule",
        rf"Tracker & Precision & Norm. precision & AUC & Success@0.5 & {' & '.join(speeds.values())} \\",
        r"\midrule",
    ]
    for i, row in enumerate(listed):
        if i and row["kind"] == "published" and listed[i - 1]["kind"] == "measured":
            lines.append(r"\midrule")
        name = _escape(row["tracker"]) + (r"$^\dagger$" if row["kind"] == "published" else "")
        cells = [_cell(row[key], row["kind"] == "measured" and row[key] == best[key]) for key in FIGURES]
        cells += ["--" if row[key] is None else f"{row[key]:.1f}" for key in speeds]
        lines.append(" & ".join([name, *cells]) + rf" \\ % {row['source']}")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""])


def _measured_row(comparison: Comparison, entry: Measured, convention: Convention) -> dict[str, Any]:
    known, empty = entry.row(convention), _empty(comparison, entry.tracker, convention)
    shown = {key: known.get(key, value) for key, value in empty.items()}
    return {**shown, "kind": "measured", "source": entry.source, "sequences": len(entry.files)}


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


def _cell(value: float | None, bold: bool) -> str:
    text = "--" if value is None else f"{value:.3f}"
    return rf"\textbf{{{text}}}" if bold else text


def _escape(text: str) -> str:
    return "".join(_LATEX.get(sign, sign) for sign in text)
