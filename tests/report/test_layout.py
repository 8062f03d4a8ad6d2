"""One table as LaTeX, CSV and text."""

from __future__ import annotations

import csv
import io

import pytest

from psiamfcpp.report.layout import (
    NONE,
    Cell,
    Row,
    Table,
    as_csv,
    as_latex,
    as_text,
    number,
    ranks,
    without_empty_columns,
)

TABLE = Table(
    "Table 7. Of A & B.",
    ["Tracker", "Prec.", "FPS", "Prec.", "Source"],
    [
        Row("a_b", [Cell("0.9", "first"), Cell(NONE), Cell("0.8"), Cell("run on x\ny")], "measured"),
        Row("c", [Cell("0.7"), Cell(NONE), Cell(NONE), Cell("paper 50 %")], "published"),
    ],
    groups=[("One", 2), ("Two", 1), ("", 1)],
    prose=["Source"],
)


def test_columns_without_a_figure_go_and_groups_shrink_with_them() -> None:
    shown = without_empty_columns(TABLE)
    assert list(shown.columns) == ["Tracker", "Prec.", "Prec.", "Source"]
    assert list(shown.groups) == [("One", 1), ("Two", 1), ("", 1)]
    assert [cell.text for cell in shown.rows[1].cells] == ["0.7", NONE, "paper 50 %"]


def test_latex_says_what_it_needs_and_bears_a_label() -> None:
    assert as_latex(TABLE, "one").splitlines() == [
        r"% needs \usepackage{booktabs} in the preamble",
        r"\begin{table}",
        r"\centering",
        r"\caption{Of A \& B. $\dagger$: as published, not measured.}",
        r"\label{tab:one}",
        r"\begin{tabular}{lrr}",
        r"\toprule",
        r" & \multicolumn{1}{c}{One} & \multicolumn{1}{c}{Two} \\",
        r"\cmidrule(lr){2-2}\cmidrule(lr){3-3}",
        r"Tracker & Prec. & Prec. \\",
        r"\midrule",
        r"a\_b & \textbf{0.9} & 0.8 \\ % run on x y",
        r"\midrule",
        r"c$^\dagger$ & 0.7 & -- \\ % paper 50 %",
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]


def test_a_wide_table_is_scaled_to_the_page() -> None:
    wide = Table("Wide.", ["", *map(str, range(9))], [Row("a", [Cell("1")] * 9)])
    text = as_latex(wide, "wide")
    assert r"\usepackage{graphicx}" in text
    assert text.count("{") == text.count("}")
    assert text.index(r"\resizebox{\textwidth}{!}{%") < text.index(r"\begin{tabular}{lrrrrrrrrr}")
    assert r"\end{tabular}}" in text


def test_csv_has_one_title_per_column() -> None:
    rows = list(csv.reader(io.StringIO(as_csv(TABLE))))
    assert rows[0] == ["Tracker", "kind", "One Prec.", "One FPS", "Two Prec.", "Source"]
    assert rows[2] == ["c", "published", "0.7", "", "", "paper 50 %"]


def test_text_is_aligned() -> None:
    lines = as_text(TABLE).splitlines()
    assert lines[1].split() == ["One", "Two"]
    column = lines[2].index("Prec.") + len("Prec.")
    assert {line[:column][-3:] for line in lines[3:] if "0." in line[:column]} == {"0.9", "0.7"}


@pytest.mark.parametrize(
    ("values", "found"),
    [
        ([0.1, None, 0.3, 0.2, 0.05], ["third", "", "first", "second", ""]),
        ([0.3, 0.3, 0.1], ["first", "first", "second"]),
        ([0.3, 0.3], ["", ""]),
        ([None], [""]),
    ],
)
def test_ranks(values: list[float | None], found: list[str]) -> None:
    assert ranks(values) == found


def test_numbers() -> None:
    assert (number(None).text, number(0.12345).text, number(12.34, digits=1).text) == (NONE, "0.123", "12.3")
