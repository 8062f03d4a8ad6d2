"""`psiamfcpp evaluate`, `calibrate` and the mistakes of `train`."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psiamfcpp.models import load

from .conftest import FRAMES, PATH, Run, read_boxes

Sequences = Callable[..., Path]
FIGURES = {"precision", "normalized_precision", "auc", "success50"}
SPEED = {"fps", "fps_mean", "threads", "jobs", "processor"}


def test_evaluate_scores_a_folder(run: Run, blob_engine: Any, blob_sequence: Sequences) -> None:
    blob_sequence("car1", PATH)
    # From frame 5 on the label is where the blob is not: the rest is missed.
    root = blob_sequence("car2", PATH)
    lines = (root / "car2" / "groundtruth_rect.txt").read_text().splitlines()
    lines[5:] = ["250,180,40,30"] * (FRAMES - 5)
    (root / "car2" / "groundtruth_rect.txt").write_text("\n".join(lines))
    ended = run("evaluate", "--root", root, "--tracker", "blob", "--json")
    assert (ended.code, ended.err) == (0, "")
    data = json.loads(ended.out)
    assert data.keys() == {"results"}
    assert [row["convention"] for row in data["results"]] == ["otb", "got10k"]
    for row in data["results"]:
        assert row.keys() == {
            "tracker",
            "dataset",
            "convention",
            "invalid_rows",
            "missing_sequences",
            "left_out",
            "sequences",
            *FIGURES,
            *SPEED,
        }
        assert (row["tracker"], row["dataset"]) == ("blob", "folder")
        assert row["fps"] > 0
        assert row["fps_mean"] > 0
        assert (row["threads"], row["jobs"]) == (1, 1)
        assert row["sequences"].keys() == {"car1", "car2"}
        assert all(figures.keys() == FIGURES for figures in row["sequences"].values())
        assert row["sequences"]["car1"]["precision"] == 1
        assert row["sequences"]["car2"]["precision"] == 0.5
        for name in FIGURES:
            assert row[name] == pytest.approx(sum(s[name] for s in row["sequences"].values()) / 2)


def test_evaluate_parts_the_conventions(run: Run, blob_engine: Any, blob_sequence: Sequences) -> None:
    root = blob_sequence("car1", PATH)
    truth = root / "car1" / "groundtruth_rect.txt"
    lines = truth.read_text().splitlines()
    lines[-1] = "nan,nan,nan,nan"
    truth.write_text("\n".join(lines))
    otb, got10k = json.loads(run("evaluate", "--root", root, "--json").out)["results"]
    assert otb["precision"] == got10k["precision"] == 1
    assert otb["success50"] == pytest.approx((FRAMES - 1) / FRAMES)
    assert otb["invalid_rows"] == got10k["invalid_rows"] == 1
    assert got10k["success50"] == 1


def test_evaluate_prints_one_table_where_the_conventions_agree_and_the_speed(
    run: Run, tiny_model: Path, blob_sequence: Sequences
) -> None:
    root = blob_sequence("car1", PATH[:3])
    ended = run("evaluate", "--root", root, "--tracker", tiny_model, "--search-size", 239, "--plain")
    assert (ended.code, ended.err) == (0, "")
    head, table, speed = ended.out.split("\n\n")
    assert head == "folder: 1 sequences, 3 labels"
    lines = table.splitlines()
    assert lines[0] == "otb and got10k agree: every row has a valid label"
    assert [line.split()[0] for line in lines[2:]] == ["tiny", "car1"]
    assert re.fullmatch(r"tiny: [\d.]+ fps \(median; mean [\d.]+\), decoding apart, 1 thread, .+\n", speed)


def test_one_model_with_two_settings_stands_side_by_side(
    run: Run, blob_engine: Any, blob_sequence: Sequences, tmp_path: Path
) -> None:
    root = blob_sequence("car1", PATH)
    base = ("evaluate", "--root", root, "--results", tmp_path / "r", "--tracker")
    ended = run(*base, "blob", "blob,plain=true", "--json", "--name", "with states", "plain")
    rows = json.loads(ended.out)["results"]
    assert [row["tracker"] for row in rows] == ["with states"] * 2 + ["plain"] * 2
    folders = {path.name: json.loads((path / "run.json").read_text()) for path in (tmp_path / "r" / "folder").iterdir()}
    assert {name: run["identity"]["plain"] for name, run in folders.items()} == {"with states": False, "plain": True}
    # another tracker under a name that is taken is refused, not mixed
    message = run(*base, "blob", "--name", "plain").refused()
    assert "was made with plain True and not False" in message


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("a", "b"), "--name gives 2 names, but --tracker 1 trackers"),
        (("../up",), "name '../up' cannot be that of a folder"),
        (("a/b",), "name 'a/b' cannot be that of a folder"),
    ],
)
def test_names_that_cannot_be_given(
    run: Run, blob_engine: Any, blob_sequence: Sequences, names: tuple[str, ...], message: str
) -> None:
    root = blob_sequence("car1", PATH[:3])
    assert message in run("evaluate", "--root", root, "--tracker", "blob", "--name", *names).refused()


def test_several_benchmarks_in_one_call(run: Run, blob_engine: Any, blob_sequence: Sequences, tmp_path: Path) -> None:
    place = tmp_path / "benchmarks"
    place.mkdir()
    shutil.copytree(blob_sequence("car1", PATH), place / "DTB70")
    shutil.copytree(place / "DTB70" / "car1" / "img", place / "UAVDT" / "sequences" / "S0101")
    (place / "UAVDT" / "anno").mkdir()
    shutil.copy(place / "DTB70" / "car1" / "groundtruth_rect.txt", place / "UAVDT" / "anno" / "S0101_gt.txt")
    command = ("evaluate", "--root", place, "--tracker", "blob", "--results", tmp_path / "r", "--dataset")
    rows = json.loads(run(*command, "dtb70", "uavdt", "--json").out)["results"]
    assert [(row["dataset"], row["convention"], row["precision"]) for row in rows] == [
        (dataset, kind, 1) for dataset in ("dtb70", "uavdt") for kind in ("otb", "got10k")
    ]
    shown = run(*command, "dtb70", "uavdt").out
    assert shown.index("dtb70: 1 of 70 sequences") < shown.index("uavdt: 1 of 50 sequences")
    # all are looked for before the first is run
    message = run(*command, "dtb70", "visdrone2018").refused()
    assert f"{place} holds no frames of visdrone2018; get it from https://" in message


def test_progress_is_said_in_lines_where_there_is_no_terminal(
    run: Run, blob_engine: Any, blob_sequence: Sequences, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psiamfcpp.cli.output.LINE_SECONDS", 0.0)
    for name in ("car1", "car2"):
        root = blob_sequence(name, PATH[:3])
    lines = run("evaluate", "--root", root, "--tracker", "blob").err.splitlines()
    assert [re.sub(r"\d+ s", "N s", line) for line in lines] == [
        "sequences: 1 of 2, N s, about N s left",
        "sequences: 2 of 2, N s, about N s left",
    ]


def test_evaluate_refuses(run: Run, tiny_model: Path, tmp_path: Path, blob_sequence: Sequences) -> None:
    base = ("evaluate", "--tracker", tiny_model, "--root")
    assert "does not exist" in run(*base, tmp_path / "none").refused()
    assert "holds no sequence" in run(*base, tmp_path).refused()
    root = blob_sequence("car1", PATH[:3])
    assert "unknown engine" in run(*base, root, "--engine", "steam").refused()
    assert "--tracker names none" in run("evaluate", "--root", root, "--tracker").refused()
    assert "--jobs is 0" in run(*base, root, "--jobs", 0).refused()
    (root / "car1" / "img" / "0002.png").write_bytes(b"")
    message = run(*base, root).refused()
    assert message.startswith("tiny on sequence car1: ")
    assert "0002.png cannot be read" in message
    (root / "car1" / "img" / "0002.png").unlink()
    assert "has 2 images but 3 boxes" in run(*base, root).refused()


def test_evaluate_keeps_results_and_goes_on_where_it_was(
    run: Run, blob_engine: Any, blob_sequence: Sequences, tmp_path: Path
) -> None:
    blob_sequence("car1", PATH)
    root = blob_sequence("car2", PATH)
    command = ("evaluate", "--root", root, "--tracker", "blob", "--results", tmp_path / "r", "--json")
    first = json.loads(run(*command).out)
    folder = tmp_path / "r" / "folder" / "blob"
    assert {path.name for path in folder.iterdir()} == {
        "run.json", "car1.txt", "car1_time.txt", "car2.txt", "car2_time.txt",
    }  # fmt: skip
    assert read_boxes(folder / "car1.txt") == pytest.approx(np.array(PATH), abs=1)
    # what is there is neither run nor touched, and gives the same figures, speed included
    blob_engine.templates.clear()
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*.txt")}
    assert json.loads(run(*command).out) == first
    assert before == {path: path.stat().st_mtime_ns for path in folder.glob("*.txt")}
    assert blob_engine.templates == []
    # and `score` says the same of it
    scored = run("score", "--dataset", "folder", "--annotations", root, "--results", tmp_path / "r", "--json")
    figures = [{key: row[key] for key in (*FIGURES, "fps", "sequences")} for row in first["results"]]
    assert [{key: row[key] for key in (*FIGURES, "fps", "sequences")} for row in json.loads(scored.out)["results"]] == (
        figures
    )


def test_evaluate_names_what_could_not_be_run_and_keeps_the_rest(
    run: Run, blob_engine: Any, blob_sequence: Sequences, tmp_path: Path
) -> None:
    for name in ("car1", "car2", "car3"):
        root = blob_sequence(name, PATH)
    (root / "car1" / "groundtruth_rect.txt").write_text("nan,nan,nan,nan\n" * FRAMES)
    (root / "car2" / "img" / "0006.png").write_bytes(b"no image")
    command = ("evaluate", "--root", root, "--tracker", "blob", "--results", tmp_path / "r")
    ended = run(*command)
    assert (ended.code, ended.out) == (2, "")
    other, error = ended.err.splitlines()
    assert other.startswith("blob on sequence car2: image ")
    assert other.endswith("0006.png cannot be read: replace or remove it")
    assert error.startswith("psiamfcpp: blob on sequence car1: no label is a box that a tracker can begin with")
    assert f"(and 1 more); what could be run is kept in {tmp_path / 'r'}; --allow-missing scores the rest" in error
    assert (tmp_path / "r" / "folder" / "blob" / "car3.txt").exists()
    assert not (tmp_path / "r" / "folder" / "blob" / "car2.txt").exists()
    ended = run(*command, "--allow-missing", "--json")
    assert ended.code == 0
    assert "blob: 2 of 3 sequences are missing and do not count" in ended.err
    assert [list(row["sequences"]) for row in json.loads(ended.out)["results"]] == [["car3"]] * 2


# calibrate


@pytest.mark.slow
def test_calibrate_stores_limits_in_a_copy(
    run: Run, blob_engine: Any, tiny_model: Path, tmp_path: Path, blob_sequence: Sequences
) -> None:
    blob_sequence("car1", PATH)
    root = blob_sequence("car2", [(x + 60, y + 40, 30, 36) for x, y, _, _ in PATH])
    before, output = tiny_model.read_bytes(), tmp_path / "calibrated.safetensors"
    command = ("calibrate", tiny_model, "--data", root, "--held-out-every", 1, "-o", output)
    ended = run(*command, "--json")
    assert (ended.code, ended.err.splitlines()) == (0, ["looking at 2 clips"])
    result = json.loads(ended.out)
    assert result.keys() == {"calibration", "rates"}
    assert (result["rates"]["clips"], result["rates"]["found_frames"]) == (2, 2 * (FRAMES - 1))
    described = json.loads(run("info", output, "--json").out)
    assert described["calibration"] == result["calibration"] != json.loads(run("info", tiny_model, "--json").out)
    assert described["provenance"]["calibration"] == result["rates"]
    assert tiny_model.read_bytes() == before
    # in half precision the weights take half the room, and the file still loads
    assert "2 clips" in run(*command, "--half", "--overwrite").out
    assert output.stat().st_size < 0.75 * len(before)
    assert load(output).spec.widths == load(tiny_model).spec.widths
    # the size of the search crop is the model's own, or the one asked for
    assert described["search_size"] == load(tiny_model).spec.search_size != 271
    assert run(*command, "--search-size", 271, "--overwrite").code == 0
    assert load(output).spec.search_size == 271
    assert {s.shape[0] for s in blob_engine.searches[-10:]} == {271}


def test_calibrate_refuses(run: Run, tiny_model: Path, tmp_path: Path, blob_sequence: Sequences) -> None:
    output = tmp_path / "calibrated.safetensors"
    root = blob_sequence("car1", PATH[:2])
    base = ("calibrate", tiny_model, "-o", output, "--held-out-every", 1, "--data")
    assert "holds 1 clips" in run(*base, root).refused()
    assert "does not exist" in run(*base, tmp_path / "none").refused()
    assert not output.exists()


# train


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("photos", "data 'photos' is not LAYOUT:FOLDER; layouts are folder, clips, stills"),
        ("photo:here", "unknown dataset layout 'photo'"),
        ("folder:nowhere", "dataset folder nowhere does not exist"),
    ],
)
def test_train_refuses(
    run: Run, tiny_model: Path, tmp_path: Path, data: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in run("train", "--data", data, "--init", tiny_model, "-o", "out").refused()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["car2/groundtruth_rect.txt", "car2/img/0003.png"])
def test_sequences_that_cannot_be_read_count_as_missing_where_that_is_allowed(
    run: Run, blob_engine: Any, blob_sequence: Sequences, name: str
) -> None:
    for sequence in ("car1", "car2", "car3"):
        root = blob_sequence(sequence, PATH[:4])
    (root / name).unlink()
    if name.endswith("txt"):
        (root / name).write_text("1,2,three,4\n")
    command = ("evaluate", "--root", root, "--tracker", "blob", "--json")
    assert "car2" in run(*command).refused()
    ended = run(*command, "--allow-missing")
    row = json.loads(ended.out)["results"][0]
    assert (list(row["sequences"]), row["missing_sequences"], list(row["left_out"])) == (["car1", "car3"], 1, ["car2"])
    assert "blob: 1 of 3 sequences are missing and do not count" in ended.err


def test_a_sequence_whose_name_is_not_utf8_is_run_and_shown(
    run: Run, blob_engine: Any, blob_sequence: Sequences
) -> None:
    root = blob_sequence("car1", PATH[:3])
    (root / "car1").rename(root / os.fsdecode(b"car\xff"))
    ended = run("evaluate", "--root", root, "--tracker", "blob")
    assert (ended.code, "car\\udcff" in ended.out) == (0, True)
