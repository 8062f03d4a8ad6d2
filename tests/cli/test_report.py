"""`psiamfcpp report`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from .conftest import PATH, Run

pytest.importorskip("matplotlib")


@pytest.fixture
def results(run: Run, blob_engine: Any, blob_sequence: Callable[..., Path], tmp_path: Path) -> Path:
    """What `evaluate` leaves of two sequences."""
    blob_sequence("car1", PATH)
    root = blob_sequence("car2", PATH)
    assert run("evaluate", "--root", root, "--tracker", "blob", "--results", tmp_path / "r").code == 0
    return tmp_path / "r"


@pytest.mark.slow
def test_what_evaluate_leaves_is_all_that_a_report_needs(run: Run, results: Path, tmp_path: Path) -> None:
    (results / "folder" / "blob" / "car2.txt").unlink()
    assert "tracker blob lacks 1 of 2 sequences" in run("report", results, "-o", tmp_path / "out").refused()
    assert not (tmp_path / "out").exists()
    ended = run("report", results, "-o", tmp_path / "out", "--allow-missing")
    assert (ended.code, ended.err) == (0, "blob: 1 of 2 sequences of folder are missing and do not count\n")
    page = tmp_path / "out" / "report.html"
    assert ended.out == f"{page} and {len(list(page.parent.iterdir())) - 1} files beside it\n"
    assert "Own sequences" in page.read_text()
    assert "blob: 1 missing" in page.read_text()


def test_benchmarks_and_annotations_come_in_pairs(run: Run, results: Path, tmp_path: Path) -> None:
    message = run("report", results, "-o", tmp_path / "out", "--dataset", "dtb70").refused()
    assert message == "--dataset names 1 benchmarks, but --annotations 0 folders"


def test_an_unknown_sequence_is_named(run: Run, results: Path, tmp_path: Path) -> None:
    message = run("report", results, "-o", tmp_path / "out", "--sequences", "car1", "car9").refused()
    assert message.startswith("sequence car9 is in none of the benchmarks")


def test_no_results(run: Run, tmp_path: Path) -> None:
    assert run("report", "-o", tmp_path / "out").refused().startswith("no folder of results is named")
    assert not (tmp_path / "out").exists()


def test_without_matplotlib_the_message_names_the_extra(
    run: Run, results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert (
        "needs matplotlib: pip install 'psiamfcpp[report]'" in run("report", results, "-o", tmp_path / "out").refused()
    )


@pytest.mark.slow
def test_published_boxes(run: Run, shared_data: Path, tmp_path: Path) -> None:
    """Boxes that others published, with the figures that they published."""
    folders = (shared_data / "results", "-o", tmp_path / "out", "--annotations", shared_data / "anno" / "UAVDT")
    ended = run("report", *folders, "--dataset", "uavdt")
    assert (ended.code, ended.err) == (0, "")
    text = (tmp_path / "out" / "report.html").read_text()
    for shown in ("AutoTrack", ">0.718<", ">0.449<", "37084 labels, of which 79 are invalid under otb"):
        assert shown in text
    assert r"AutoTrack$^\ddagger$ & \textbf{0.718}" in (tmp_path / "out" / "table-uavdt-otb.tex").read_text()
