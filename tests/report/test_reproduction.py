"""Ours beside the paper's, cell by cell."""

from __future__ import annotations

import dataclasses
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.evaluation.measured import Measured
from psiamfcpp.evaluation.results import Speed
from psiamfcpp.report.compare import Comparison
from psiamfcpp.report.layout import as_latex
from psiamfcpp.report.published import averaged, gains, published
from psiamfcpp.report.reproduction import ON_GPU, Reproduction, gains_table, paper_name, tables

RUN = {"threads": 1, "jobs": 1, "processor": "x", "identity": {"plain": True}}


def measured(
    comparison: Comparison, tracker: str, precision: float, fps: float, run: dict[str, Any] | None
) -> Measured:
    """A tracker with the same precision under both conventions."""
    entry = comparison.measured[0]
    scores = entry.mean["otb"]
    curve = scores.precision_curve * 0 + precision
    mean = {kind: dataclasses.replace(scores, precision_curve=curve) for kind in entry.mean}
    return dataclasses.replace(entry, tracker=tracker, mean=mean, speed=Speed(fps, fps), run=run)  # type: ignore[arg-type]


@pytest.fixture
def four(comparison: Comparison) -> Reproduction:
    """The four benchmarks, as large as they are officially, with KCF, both networks, and one of them on a GPU."""
    comparisons = []
    for i, name in enumerate(averaged()):
        entries = [
            measured(comparison, "dcf-kcf", 0.5, 300 + i, RUN),
            measured(comparison, "siamfcpp-alexnet", 0.7, 20, RUN),
            measured(comparison, "psiamfcpp-alexnet-int8,plain=true", 0.75, 40, RUN),
            measured(comparison, "P-SiamFC++" + ON_GPU, 0.75, 200, RUN),
        ]
        entries[0] = dataclasses.replace(entries[0], tracker="KCF")
        sequences = [f"s{k}" for k in range(BENCHMARKS[name].size or 0)]
        comparisons.append(dataclasses.replace(comparison, dataset=name, sequences=sequences, measured=entries))
    return Reproduction(comparisons, {"SiamFC++": 9_660_000, "P-SiamFC++": 7_490_000})


def cells(found: Reproduction, table: int, name: str, place: int = 0) -> list[str]:
    rows = [row for row in tables(found)[table].rows if row.name == name]
    return [cell.text for cell in rows[place].cells]


@pytest.mark.slow
def test_averages_stand_beside_the_papers_with_their_difference(four: Reproduction) -> None:
    auc = f"{100 * four.comparisons[0].measured[0].mean['otb'].figures['auc']:.1f}"
    assert cells(four, 1, "KCF") == ["53.3", "otb", "622.5", "50.0", "50.0", auc, "301.5", "-3.3", ""]
    assert cells(four, 1, "P-SiamFC++")[7] == "-3.8"
    assert cells(four, 1, "STRCF")[3:] == ["\u2013"] * 5 + ["not measured"]


@pytest.mark.slow
def test_a_difference_needs_the_same_benchmarks_whole(four: Reproduction) -> None:
    three = dataclasses.replace(four, comparisons=four.comparisons[:3])
    assert cells(three, 1, "KCF")[7:] == ["\u2013", "over UAV123@10fps, DTB70, UAVDT only"]
    cut = dataclasses.replace(four.comparisons[0], sequences=["s0"])
    partial = dataclasses.replace(four, comparisons=[cut, *four.comparisons[1:]])
    assert cells(partial, 1, "KCF")[7] == "\u2013"
    assert "UAV123@10fps (1 of 123 sequences)" in tables(partial)[1].caption


@pytest.mark.slow
def test_speed_on_a_gpu_is_that_of_the_run_there(four: Reproduction) -> None:
    assert cells(four, 2, "P-SiamFC++")[3:7] == ["75.0", "75.0", "200.0", "-5.7"]
    assert cells(four, 3, "P-SiamFC++", 2)[:5] == ["7.49 M", "got10k", "75.0", "40.0", "200.0"]
    assert cells(four, 3, "P-SiamFC++", 2)[-3:] == ["75.0", "40.0", "200.0"]
    assert cells(four, 3, "SiamFC++", 1)[-3:] == ["70.0", "20.0", "not measured"]


def test_a_run_with_states_is_not_the_published_procedure(four: Reproduction) -> None:
    states = {**RUN, "identity": {"plain": False}}
    changed = [
        dataclasses.replace(c, measured=[dataclasses.replace(m, run=states) for m in c.measured])
        for c in four.comparisons
    ]
    assert cells(dataclasses.replace(four, comparisons=changed), 1, "P-SiamFC++")[-1] == "not measured"


@pytest.mark.slow
def test_ratios_stand_below_the_papers(four: Reproduction) -> None:
    ratios = [
        {"layer": "L1 (Head)", "share": 0.2, "tuned": tuned, "precision": 0.5 + tuned / 4} for tuned in (False, True)
    ]
    found = dataclasses.replace(four, ratios=ratios, budget=40)
    assert cells(found, 4, "L1 (Head)")[1:3] == ["77.5", "77.9"]
    assert cells(found, 4, "L1 (Head)", 1)[:3] == ["none", "\u2013", "50.0"]
    assert cells(found, 4, "L1 (Head)", 2)[:3] == ["40 steps", "\u2013", "75.0"]


def test_stated_gains_agree_with_the_printed_average_of_racf() -> None:
    pruned = {r.dataset: r.precision for r in published() if r.tracker == "P-SiamFC++" and "Table 3" in r.source}
    racf = [pruned[name] - gains()["precision"][name] for name in averaged()]
    (printed,) = (row.precision for row in published() if row.tracker == "RACF")
    assert sum(racf) / 4 == pytest.approx(printed, abs=0.0011)


def test_ours_exceeds_the_best_filter_by_so_much(four: Reproduction) -> None:
    row = gains_table(four).rows[1]
    assert (row.name, [cell.text for cell in row.cells]) == ("DTB70", ["+7.8", "+9.9", "+25.0", "+0.0", "KCF"])


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("Staple_CA", "Staple-CA"), ("ECO_HC", "ECO-HC"), ("fDSST", "fDSST"), ("ARCF", "ARCF-HC"), ("ARCF_H", "ARCF_H"),
        ("SAOT", "SOAT"), ("siamfcpp-alexnet", "SiamFC++"), ("psiamfcpp-alexnet-int8", "P-SiamFC++"),
        ("psiamfcpp-alexnet-s-int8", "psiamfcpp-alexnet-s-int8"), ("NanoTrack", "NanoTrack"),
    ],
)  # fmt: skip
def test_folders_bear_the_papers_names(folder: str, name: str) -> None:
    assert paper_name(folder) == name


def test_a_page_without_results_is_written(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from psiamfcpp.recipes.reproduce import there
    from psiamfcpp.report.reproduction_page import write_reproduction

    nothing = Reproduction()
    files = write_reproduction(nothing, tables(nothing), there(dict.fromkeys(averaged())), ["x < y"], tmp_path)
    assert "x &lt; y" in files[0].read_text()
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in files}


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_every_latex_row_has_as_many_cells_as_the_table_has_columns(four: Reproduction, number: int) -> None:
    text = as_latex(tables(four)[number], "x")
    (columns,) = re.findall(r"\\begin\{tabular\}\{([lr]+)\}", text)
    rows = [line.partition(r" \\")[0] for line in text.splitlines() if r" \\" in line]
    spans = [
        sum(int(span) for span in re.findall(r"\\multicolumn\{(\d+)\}", row)) - row.count(r"\multicolumn")
        for row in rows
    ]
    assert {row.count("&") + 1 + span for row, span in zip(rows, spans, strict=True)} == {len(columns)}
    assert text.count("{") == text.count("}")


@pytest.mark.slow
def test_the_tables_compile_with_latex_and_fit_the_page(four: Reproduction, tmp_path: Path) -> None:
    if shutil.which("pdflatex") is None:
        pytest.skip("pdflatex is not installed")
    from psiamfcpp.report.reproduction_page import latex_document

    made = tables(four)
    text = latex_document([as_latex(table, f"reproduced-{i}") for i, table in made.items()])
    (tmp_path / "tables.tex").write_text(text)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "tables.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert (tmp_path / "tables.pdf").read_bytes().startswith(b"%PDF")
    assert "Overfull" not in done.stdout
