"""`psiamfcpp sensitivity`: every cell once, whatever stops it."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.recipes.sensitivity_report import criteria_table, ratio_table

from .conftest import Run

TUNING = ["--steps", "2", "--batch", "2", "--search-size", "191"]


@pytest.fixture
def clips(blob_sequence: Callable[..., Path]) -> Path:
    blob_sequence("blob", [(90.0 + 3 * t, 80.0, 40, 30) for t in range(3)])
    return blob_sequence("other", [(120.0, 80.0 + 3 * t, 30, 36) for t in range(3)])


@pytest.fixture
def ranks(tmp_path: Path) -> Path:
    """A table of the narrow model: ranks 1 to 8."""
    groups = {name: {"rank": list(range(1, 9)), "max": 9} for name in ARCHITECTURE.groups}
    path = tmp_path / "ranks.json"
    path.write_text(json.dumps({"format": "psiamfcpp-ranks/1", "images": 9, "groups": groups}))
    return path


@pytest.mark.slow
def test_cells_without_and_with_fine_tuning(
    run: Run, tiny_model: Path, ranks: Path, clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "out"
    args = ["sensitivity", tiny_model, "--ranks", ranks, "--root", clips, "-o", output, "--data", f"folder:{clips}"]
    args += [*TUNING, "--rows", "head.2", "--shares", "0.25", "0.5"]

    from psiamfcpp.recipes import sensitivity

    measured: list[str] = []
    measure = sensitivity.measure

    def die_at_the_fourth(setup: sensitivity.Setup, cell: sensitivity.Cell, folder: Path) -> dict[str, Any]:
        measured.append(cell.name)
        if len(measured) == 4:
            raise KeyboardInterrupt
        return measure(setup, cell, folder)

    monkeypatch.setattr(sensitivity, "measure", die_at_the_fourth)
    assert run(*args).code == 130
    assert len(list(output.glob("*_*.json"))) == 3
    # what was measured until then can be looked at
    assert len(list(csv.DictReader((output / "table.csv").open()))) == 3
    ended = run(*args, "--json")
    assert (ended.code, ended.err) == (0, "")
    # One more than cells: the one that was interrupted.
    found = json.loads(ended.out)["cells"]
    assert len(measured) == 1 + len(found) and len(set(measured)) == len(found) == 1 + 2 * (2 + 5)
    assert found[0]["row"] == "unpruned"
    by_key = {(r["row"], r["share"], r["criterion"], r["tuned"]): r for r in found}
    assert by_key["head.2", 0.5, "rank", True]["parameters"] == by_key["head.2", 0.5, "rank", False]["parameters"]
    half, quarter = (by_key["head.2", share, "rank", False]["parameters"] for share in (0.5, 0.25))
    assert quarter < half < found[0]["parameters"]
    # The criteria choose other filters, but as many.
    assert len({r["parameters"] for r in found if r["row"] == "paper"}) == 1
    assert all(0 <= r[figure] <= 1 for r in found for figure in ("precision", "auc"))
    with (output / "table.csv").open() as file:
        assert [float(row["precision"]) for row in csv.DictReader(file)] == [r["precision"] for r in found]
    assert (output / "sensitivity.png").read_bytes().startswith(b"\x89PNG")
    assert not list(output.glob("*.run"))

    text = run(*args).out
    assert len(measured) == 1 + len(found)
    assert "not fine-tuned" in text and "taylor" in text
    assert "other output folder" in run(*args, "--steps", 3).refused().replace("another", "other")


@pytest.mark.slow
def test_cells_are_shared_among_processes(run: Run, tiny_model: Path, ranks: Path, clips: Path, tmp_path: Path) -> None:
    args = [
        "sensitivity",
        tiny_model,
        "--ranks",
        ranks,
        "--root",
        clips,
        "--rows",
        "head.1",
        "--shares",
        "0.5",
        "--json",
    ]
    alone, together = (run(*args, "-o", tmp_path / str(jobs), "--jobs", jobs) for jobs in (1, 2))
    assert alone.code == together.code == 0
    assert json.loads(alone.out) == json.loads(together.out)
    # Without training data nothing is fine-tuned, and no loss has a gradient.
    assert {(r["tuned"], r["criterion"]) for r in json.loads(alone.out)["cells"]} == {
        (False, c) for c in ("rank", "norm", "median", "random")
    }


def test_tables_of_text() -> None:
    def cell(row: str, share: float | None, precision: float, criterion: str = "rank", tuned: bool = False) -> Any:
        return {
            "row": row, "share": share, "criterion": criterion, "tuned": tuned, "precision": precision, "auc": 0.5,
        }  # fmt: skip

    results = [
        cell("head.1", 0.2, 0.7),
        cell("head.1", 0.1, 0.8),
        cell("head.2", 0.2, 0.65),
        cell("head.1", 0.1, 0.3, tuned=True),
    ]
    assert [line.split() for line in ratio_table(results, tuned=False).splitlines()] == [
        ["kept", "0.1", "0.2"],
        ["head.1", "0.800*", "0.700"],
        ["head.2", "-", "0.650*"],
    ]
    rows = [cell("paper", None, 0.6), cell("paper", None, 0.9, tuned=True), cell("paper", None, 0.4, "random")]
    assert [line.split() for line in criteria_table(rows).splitlines()[1:]] == [
        ["rank", "0.600", "0.500", "0.900", "0.500"],
        ["random", "0.400", "0.500", "-", "-"],
    ]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--rows", "head.4"], "unknown row 'head.4'"),
        (["--shares", "0.5", "1.5"], "share to keep is 1.5"),
        (["--jobs", "0"], "at least 1"),
        (["--ranks", "absent.json"], "absent.json"),
        (["--root", "absent"], "absent"),
    ],
)
def test_refusals(
    run: Run, tiny_model: Path, ranks: Path, clips: Path, tmp_path: Path, options: list[str], message: str
) -> None:
    args: dict[str, list[object]] = {"--ranks": [ranks], "--root": [clips], "-o": [tmp_path / "out"]}
    args[options[0]] = [*options[1:]]
    given = [part for name, values in args.items() for part in (name, *values)]
    assert message in run("sensitivity", tiny_model, *given).refused()
