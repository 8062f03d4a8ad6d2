"""Figures stand in docs/results.csv once: page, README and model cards show what it holds."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path
from types import ModuleType

import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.zoo import graph_folder, graph_names

ROOT = Path(__file__).parents[1]
CARDS = sorted((ROOT / "src/psiamfcpp/zoo").glob("*.md"))
SECTIONS = {"Fifteen sequences": "fifteen", "Seven sequences": "seven"}
_ROW = re.compile(r"^\| `(?P<model>[\w-]+)(?P<plain> --plain)?` \| (?P<precision>[\d.]+) \| (?P<auc>[\d.]+) \|$", re.M)


@pytest.fixture
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_results", ROOT / "docs/make_results.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def figures(script: ModuleType) -> dict[tuple[str, str, str, str], str]:
    return {tuple(figure[:4]): figure.value for figure in script.read()}


def test_the_page_is_what_the_script_makes_of_the_table(script: ModuleType) -> None:
    text = script.PAGE.read_text()
    assert script.page(text) == text, "python docs/make_results.py write"


@pytest.mark.parametrize("card", CARDS, ids=lambda card: card.stem)
def test_cards_show_the_figures_of_the_table(card: Path, figures: dict[tuple[str, ...], str]) -> None:
    rows = 0
    for title, name in SECTIONS.items():
        section = card.read_text().partition(f"## {title}")[2].partition("\n## ")[0]
        for row in _ROW.finditer(section):
            if (name, row["model"], "states", "auc") in figures:
                procedure = "plain" if row["plain"] else "states"
                shown = [figures[name, row["model"], procedure, figure] for figure in ("precision", "auc")]
                assert [row["precision"], row["auc"]] == shown, row[0]
                rows += 1
    assert rows >= 2


def test_the_readme_shows_the_figures_of_the_table(figures: dict[tuple[str, ...], str]) -> None:
    table = (ROOT / "README.md").read_text().partition("## Models")[2].partition("## ")[0]
    rows = [
        [cell.strip() for cell in line.split("|")[1:7]] for line in table.splitlines() if re.search(r"\| 0\.\d", line)
    ]
    assert len(rows) == 12
    for name, precision, auc, ms, slow_ms, _ in rows:
        tracker = re.split(r"`|,| in OpenCV", name.removeprefix("`"))[0]
        states = "states" if ("fifteen", tracker, "states", "auc") in figures else ""
        assert [precision, auc] == [figures["fifteen", tracker, states, figure] for figure in ("precision", "auc")]
        for shown, key in ((ms, ("update", "ms2")), (slow_ms, ("avx2", "ms2"))):
            assert shown == figures.get((key[0], tracker, "plain" if states else "", key[1]), "not measured"), tracker


@pytest.mark.parametrize("model", [name for name in graph_names() if name.endswith("-int8")])
def test_readme_and_card_state_the_size_of_the_files(model: str) -> None:
    folder = graph_folder(model)
    assert folder
    size = f"{sum(path.stat().st_size for path in folder.glob('*.onnx')) / 1e6:.1f}"
    (line,) = re.findall(rf"^\| `{model}`.*", (ROOT / "README.md").read_text(), re.M)
    assert line.split("|")[6].strip() == size
    assert f"| {size} (int8)" in (ROOT / f"src/psiamfcpp/zoo/{model.removesuffix('-int8')}.md").read_text()


def test_runs_are_averaged_over_all_their_sequences(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "TABLE", tmp_path / "results.csv")
    script.TABLE.write_text(
        ",".join(script.Figure._fields) + "\nseven,old,plain,auc,0.1,c\nseven,ours,plain,auc,0.2,c\n"
    )
    for number, values in enumerate([[0.5, 0.7], [0.3]]):
        sequences = {f"{at}": {"precision": value, "auc": value / 2} for at, value in enumerate(values)}
        row = {"tracker": "ours", "convention": "otb", "sequences": sequences}
        other = {**row, "convention": "got10k", "sequences": {"a": {"precision": 1.0, "auc": 1.0}}}
        (tmp_path / f"{number}.json").write_text(json.dumps({"results": [row, other]}))
    script.add((tmp_path / "0.json", tmp_path / "1.json"), "seven", "evaluate --tracker MODEL", "plain")
    assert [tuple(figure) for figure in script.read()] == [
        ("seven", "old", "plain", "auc", "0.1", "c"),
        ("seven", "ours", "plain", "auc", "0.250", "evaluate --tracker ours"),
        ("seven", "ours", "plain", "precision", "0.500", "evaluate --tracker ours"),
    ]
    with pytest.raises(UserError, match="unknown set 'eight'"):
        script.add((), "eight", "")


def test_times_keep_the_number_of_threads(script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "TABLE", tmp_path / "results.csv")
    script.TABLE.write_text(",".join(script.Figure._fields) + "\n")
    for threads in (1, 2):
        rows = [{"model": name, "ms_median": 6.04 / threads} for name in ("plightfc-int8", "opencv-mil")]
        (tmp_path / f"{threads}.json").write_text(json.dumps({"rows": rows, "threads": threads}))
    script.add((tmp_path / "1.json", tmp_path / "2.json"), "avx2", "bench")
    assert [tuple(figure) for figure in script.read()] == [
        ("avx2", "plightfc-int8", "plain", "ms1", "6.0", "bench"),
        ("avx2", "MIL", "", "ms1", "6.0", "bench"),
        ("avx2", "plightfc-int8", "plain", "ms2", "3.0", "bench"),
        ("avx2", "MIL", "", "ms2", "3.0", "bench"),
    ]


def test_the_front_is_what_nothing_beats_in_time_and_precision(script: ModuleType) -> None:
    points = {name: script.Point(name, ms, precision) for name, ms, precision in (
        ("slow", 9.0, 0.9), ("beaten", 9.0, 0.8), ("worse", 5.0, 0.6), ("fast", 2.0, 0.7), ("equal", 3.0, 0.7)
    )}  # fmt: skip
    assert script.front(list(points.values())) == [points["fast"], points["slow"]]


def test_the_picture_shows_the_trackers_of_the_table(script: ModuleType) -> None:
    shown = set(re.findall(r">([\w][^<>]*)</text>", script.CHART.read_text()))
    names = {point.tracker for point in script.points()}
    assert len(names) >= 8
    assert names <= shown
