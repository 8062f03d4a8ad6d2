from __future__ import annotations

import json
from pathlib import Path

import pytest

from psiamfcpp.cli import main
from psiamfcpp.trackers.listing import list_trackers
from psiamfcpp.zoo import DEFAULT_MODEL


def test_every_kind_is_listed_with_what_is_missing() -> None:
    rows = list_trackers()
    kinds = {row.kind for row in rows}
    assert {"model", "opencv", "nanotrack", "adapter", "trax", "module"} <= kinds
    by_name = {(row.kind, row.name): row for row in rows}
    assert by_name["model", DEFAULT_MODEL].missing == []
    transt = by_name["adapter", "TransT"]
    assert transt.write.startswith("adapter:transt,checkout=DIR")
    assert any(text.startswith("checkout: git clone") for text in transt.missing)
    assert transt.facts["colour"] == "rgb"
    assert len([row for row in rows if row.kind == "adapter"]) == 10


def test_the_command_prints_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trackers", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["trackers"]
    assert [row["name"] for row in rows] == [row.name for row in list_trackers()]
    (hift,) = (row for row in rows if row["name"] == "HiFT")
    assert hift["facts"]["repository"] == "https://github.com/vision4robotics/HiFT"

    (tmp_path / "w.pth").touch()
    option = f"adapter:hift,checkout={tmp_path},weights={tmp_path / 'w.pth'}"
    assert main(["trackers", "--adapter", option]) == 0
    lines = capsys.readouterr().out.splitlines()
    start = next(index for index, line in enumerate(lines) if "HiFT" in line)
    about = "\n".join(lines[start : start + 4])
    assert "missing checkout" not in about and "missing weights" not in about


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("siamfc,checkout=.", "unknown adapter 'siamfc'"),
        ("hift,checkout", "'checkout' is not KEY=VALUE"),
        ("hift,checkout=/nowhere", "checkout /nowhere of adapter:hift does not exist"),
    ],
)
def test_adapters_that_cannot_be_looked_for(text: str, part: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trackers", "--adapter", text]) == 2
    assert part in capsys.readouterr().err
