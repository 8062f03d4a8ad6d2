"""`psiamfcpp reproduce`."""

from __future__ import annotations

import json
from pathlib import Path

from .conftest import Run


def test_the_published_side_is_printed(run: Run) -> None:
    ended = run("reproduce", "--table", 2)
    assert (ended.code, ended.err) == (0, "")
    assert "Table 2." in ended.out
    assert "TransT" in ended.out
    assert "Table 1." not in ended.out


def test_rows_for_programs(run: Run) -> None:
    tables = json.loads(run("reproduce", "--json").out)["tables"]
    assert list(tables) == ["1", "2", "3", "4"]
    assert tables["1"]["rows"][0][:5] == ["KCF", "", "53.3", "otb", "622.5"]
    assert all(len(row) == len(tables["3"]["columns"]) + 1 for row in tables["3"]["rows"])


def test_nothing_to_be_run_is_said(run: Run, tmp_path: Path) -> None:
    ended = run("reproduce", "--root", tmp_path, "--dry-run")
    assert ended.code == 0
    assert ended.out.count("not found; from https://") == 4
    assert "Nothing is left to be run." in ended.out


def test_wrong_options_are_refused(run: Run, tmp_path: Path) -> None:
    assert "table 9 is not in the paper" in run("reproduce", "--table", 9).refused()
    assert "nowhere does not exist" in run("reproduce", "--root", tmp_path / "nowhere").refused()
