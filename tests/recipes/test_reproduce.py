"""The paper from one call, on miniatures of its benchmarks in the official layouts."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.models.arch import DEFAULT, architecture
from psiamfcpp.recipes import reproduce as recipe
from psiamfcpp.recipes.reproduce import Reproduced, reproduce
from psiamfcpp.report.layout import Table
from psiamfcpp.report.published import pruned_layers

from .conftest import PATH

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")


@pytest.fixture(autouse=True)
def no_filters(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Correlation filters compile for seconds; one test has one."""
    monkeypatch.setattr(recipe, "FILTERS", {})
    yield


def line(table: Table, name: str, place: int = 0) -> list[str]:
    """The cells of a row; of rows of one name, the one at a place."""
    return [[cell.text for cell in row.cells] for row in table.rows if row.name == name][place]


def write_boxes(folder: Path, sequence: str, boxes: Any = PATH) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{sequence}.txt").write_text("".join(",".join(map(str, box)) + "\n" for box in boxes))


def test_without_anything_the_published_side_is_returned() -> None:
    done = reproduce()
    assert list(done.tables) == [1, 2, 3, 4]
    assert (done.planned, done.files) == ([], [])
    assert line(done.tables[1], "KCF")[:3] == ["53.3", "otb", "622.5"]
    assert line(done.tables[1], "RACF")[-1].startswith("published only")
    assert line(done.tables[2], "TransT")[0] == "82.6"
    assert [row.kind for row in done.tables[3].rows] == ["published"] * 2
    assert line(done.tables[4], "L4 (Backbone)")[1:3] == ["79.0", "81.7"]


def test_a_dry_run_says_what_is_missing_and_what_would_be_run(
    benchmarks: Path, blob_engine: Any, tmp_path: Path
) -> None:
    shutil.rmtree(benchmarks / "UAVDT")
    shutil.rmtree(benchmarks / "DTB70" / "BMX3" / "img")
    done = reproduce(benchmarks, tmp_path / "out", dry_run=True)
    assert not (tmp_path / "out").exists()
    assert [(p.dataset, p.tracker, p.sequences, p.frames) for p in done.planned] == [
        (dataset, tracker, 1, 5)
        for dataset in ("uav123-10fps", "visdrone2018")
        for tracker in ("SiamFC++", "P-SiamFC++")
    ]
    assert all(p.seconds is not None and p.seconds > 0 for p in done.planned)
    states = {row.name: row.cells[-1].text for row in recipe.there(done.found).rows}
    assert states["UAVDT"].startswith("not found; from https://sites.google.com/view/grli-uavdt; expected layout")
    assert states["DTB70"].startswith("labels only")
    assert states["VisDrone2018"].startswith("not the whole benchmark of 35 sequences")


@pytest.mark.parametrize(
    ("wanted", "planned"),
    [
        ((1,), [(d, "P-SiamFC++") for d in ("uav123-10fps", "dtb70", "uavdt", "visdrone2018")]),
        ((2,), [("uavdt", "P-SiamFC++")]),
        ((4,), []),
    ],
)
def test_a_table_needs_its_own_runs_only(
    benchmarks: Path, blob_engine: Any, wanted: tuple[int, ...], planned: list[tuple[str, str]]
) -> None:
    done = reproduce(benchmarks, wanted=wanted, dry_run=True)
    assert [(p.dataset, p.tracker) for p in done.planned] == planned


@pytest.fixture
def done(benchmarks: Path, blob_engine: Any, tmp_path: Path) -> Reproduced:
    """All that can be run, was."""
    return reproduce(benchmarks, tmp_path / "out")


@pytest.mark.slow
def test_everything_is_run_scored_and_written(done: Reproduced, tmp_path: Path) -> None:
    ours = line(done.tables[1], "P-SiamFC++")
    assert ours[:5] == ["78.8", "got10k", "46.1", "100.0", "100.0"]
    # A miniature is not the benchmark, so no difference is stated.
    assert ours[7] == "\u2013"
    assert "Not the whole benchmark: UAV123@10fps (1 of 123 sequences)" in done.tables[1].caption
    published, otb, got10k = (line(done.tables[3], "SiamFC++", i) for i in range(3))
    assert published[2:5] == ["72.8", "29.0", "212.1"]
    assert (otb[1], got10k[1]) == ("otb", "got10k")
    assert otb[2] == otb[14] == "100.0"
    assert otb[4] == "not measured"
    names = {path.name for path in done.files}
    assert {"reproduce.html", "table1.tex", "table3.csv", "tables.tex", "fig2-success-dtb70-otb.pdf"} <= names
    assert {"fig3-boat3.jpg", "fig3-BMX3.jpg", "fig3-S0304.jpg"} <= names
    page = done.files[0].read_text()
    assert all(f"<h2>{part}</h2>" in page for part in ("Table 1", "Table 4", "Fig. 2", "Fig. 3"))
    text = (tmp_path / "out" / "tables.tex").read_text()
    assert text.count(r"\begin") == text.count(r"\end{")
    assert len(re.findall(r"\\label\{tab:reproduced-\d\}", text)) == 4


@pytest.mark.slow
def test_what_is_done_is_not_run_again(
    done: Reproduced, benchmarks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert reproduce(benchmarks, tmp_path / "out", dry_run=True).planned == []
    cut = tmp_path / "out" / "results" / "dtb70" / "P-SiamFC++" / "BMX3.txt"
    before = cut.read_text()
    cut.write_text(before[: len(before) // 2])
    again = reproduce(benchmarks, tmp_path / "out", dry_run=True)
    assert [(p.dataset, p.tracker) for p in again.planned] == [("dtb70", "P-SiamFC++")]
    reproduce(benchmarks, tmp_path / "out")
    assert cut.read_text() == before


@pytest.mark.slow
def test_result_files_will_do_without_frames(benchmarks: Path, tmp_path: Path) -> None:
    for folder in benchmarks.glob("**/*.jpg"):
        folder.unlink()
    for benchmark, sequence in (("dtb70", "BMX3"), ("uavdt", "S0304")):
        write_boxes(tmp_path / "theirs" / benchmark / "ECO_HC", sequence)
        write_boxes(tmp_path / "theirs" / benchmark / "ARCF", sequence, np.array(PATH) + 100)
    write_boxes(tmp_path / "theirs" / "uavdt" / "SAOT", "S0304")
    done = reproduce(benchmarks, tmp_path / "out", results=[tmp_path / "theirs"], wanted=(1, 2))
    assert line(done.tables[1], "ECO-HC")[3:5] == ["100.0", "100.0"]
    assert line(done.tables[1], "ECO-HC")[-1] == "over DTB70, UAVDT only; scored from boxes of others"
    assert float(line(done.tables[1], "ARCF-HC")[3]) < 50
    assert line(done.tables[2], "SOAT")[3] == "100.0"
    assert "BMX3: its frames are not at hand." in done.files[0].read_text()


@pytest.mark.slow
def test_of_two_trackers_of_one_name_ours_stands(benchmarks: Path, blob_engine: Any, tmp_path: Path) -> None:
    for tracker in ("P-SiamFC++", "HiFT"):
        write_boxes(tmp_path / "theirs" / "uavdt" / tracker, "S0304", np.array(PATH) + 100)
    done = reproduce(benchmarks, tmp_path / "out", results=[tmp_path / "theirs"], wanted=(2,))
    assert line(done.tables[2], "P-SiamFC++")[3] == "100.0"
    assert float(line(done.tables[2], "HiFT")[3]) < 50


def test_results_that_cannot_be_scored_are_named_before_anything_is_run(
    benchmarks: Path, blob_engine: Any, tmp_path: Path
) -> None:
    write_boxes(tmp_path / "theirs" / "uavdt" / "HiFT", "S0304", PATH[:3])
    with pytest.raises(UserError, match=r"HiFT/S0304\.txt have 3 rows, but 5 are needed"):
        reproduce(benchmarks, tmp_path / "out", results=[tmp_path / "theirs"], wanted=(2,))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_deep_tracker_that_cannot_be_opened_is_named_and_left_out(
    benchmarks: Path, blob_engine: Any, tmp_path: Path
) -> None:
    given = f"transt,checkout={tmp_path / 'nowhere'},weights=random"
    done = reproduce(benchmarks, tmp_path / "out", wanted=(2,), checkouts=[given])
    (problem,) = done.problems
    assert problem.startswith("TransT is left out: checkout ")
    assert line(done.tables[2], "TransT")[-1] == "not measured"
    assert line(done.tables[2], "P-SiamFC++")[3] == "100.0"
    assert problem[:20] in done.files[0].read_text()
    with pytest.raises(UserError, match="unknown adapter 'transy'"):
        reproduce(benchmarks, checkouts=["transy,checkout=x"])


@pytest.mark.slow
def test_correlation_filters_bear_the_papers_names(
    benchmarks: Path, blob_engine: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("numba")
    monkeypatch.setattr(recipe, "FILTERS", {"kcf": (), "cn": ()})
    done = reproduce(benchmarks, tmp_path / "out", wanted=(1,))
    assert done.problems == []
    kcf = line(done.tables[1], "KCF")
    assert (kcf[3], kcf[-1]) == ("100.0", "")
    assert float(kcf[5]) > 0
    assert (tmp_path / "out" / "results" / "dtb70" / "KCF" / "run.json").is_file()


@pytest.mark.slow
def test_table_4_is_measured_from_a_rank_table(
    benchmarks: Path, tiny_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch")
    monkeypatch.setattr(recipe, "MODELS", dict.fromkeys(recipe.MODELS, str(tiny_model)))
    one_ratio = [dataclasses.replace(layer, precision={0.5: layer.precision[0.5]}) for layer in pruned_layers()]
    monkeypatch.setattr("psiamfcpp.recipes.reproduce_ratios.pruned_layers", lambda: one_ratio)
    ranks = tmp_path / "ranks.json"
    groups = {name: {"rank": list(range(1, 9))} for name in architecture(DEFAULT).groups}
    ranks.write_text(json.dumps({"format": "psiamfcpp-ranks/1", "images": 9, "groups": groups}))
    done = reproduce(benchmarks, tmp_path / "out", wanted=(4,), ranks=ranks)
    assert [(p.tracker, p.frames) for p in done.planned] == [("9 networks of Table 4", 9 * 5)]
    assert reproduce(benchmarks, tmp_path / "out", wanted=(4,), ranks=ranks, dry_run=True).planned == []
    for layer in pruned_layers():
        printed, ours = (line(done.tables[4], layer.layer, place) for place in range(2))
        assert (printed[0], ours[0]) == ("as printed", "none")
        assert [text != "\u2013" for text in ours[1:]] == [ratio == 0.5 for ratio in layer.precision]
    # what is measured is shown without being asked for again
    assert line(reproduce(benchmarks, tmp_path / "out", wanted=(4,)).tables[4], "L1 (Head)", 1)[0] == "none"


def test_wrong_use_is_refused(benchmarks: Path, blob_engine: Any, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="table 5 is not in the paper"):
        reproduce(wanted=(5,))
    with pytest.raises(UserError, match="nowhere does not exist"):
        reproduce(tmp_path / "nowhere")
    with pytest.raises(UserError, match="--results needs the labels"):
        reproduce(results=[tmp_path])
    with pytest.raises(UserError, match="give -o DIR"):
        reproduce(benchmarks)
    with pytest.raises(UserError, match="--finetune-steps 0"):
        reproduce(finetune_steps=0)
