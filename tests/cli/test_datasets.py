"""`psiamfcpp datasets`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from psiamfcpp.datasets import BENCHMARKS

from .conftest import Run


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A whole DTB70 of one sequence, labels alone of UAVDT, and a VisDrone that is no such thing."""
    files = {
        "DTB70/Car6/groundtruth_rect.txt": "1,2,3,4\n",
        "DTB70/Car6/img/00001.jpg": "",
        "uavdt/S0101.txt": "1,2,3,4\n5,6,7,8\n",
        "VisDrone2018-SOT-test-dev/readme.md": "",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_every_benchmark_is_listed_with_its_source(run: Run) -> None:
    ended = run("datasets")
    assert (ended.code, ended.err) == (0, "")
    for benchmark in BENCHMARKS.values():
        assert benchmark.name in ended.out
        assert benchmark.source in ended.out
        assert benchmark.layout in ended.out
    rows = json.loads(run("datasets", "--json").out)["datasets"]
    assert [row["name"] for row in rows] == list(BENCHMARKS)
    assert {row["found"] for row in rows} == {None}


def test_what_is_there(run: Run, root: Path) -> None:
    found = {r["name"]: r["found"] for r in json.loads(run("datasets", "--root", root, "--json").out)["datasets"]}
    whole = {"root": str(root / "DTB70"), "sequences": 1, "labels": 1, "frames": 1, "problem": None}
    assert found["dtb70"] == whole
    assert found["folder"] == whole | {"root": str(root)}
    assert (found["uavdt"]["sequences"], found["uavdt"]["labels"], found["uavdt"]["frames"]) == (1, 2, 0)
    assert "annotations/<sequence>.txt is missing; expected layout" in found["visdrone2018"]["problem"]
    assert found["otb100"] is found["uav20l"] is None


def test_a_root_that_is_a_benchmark(run: Run, root: Path) -> None:
    found = {
        r["name"]: r["found"] for r in json.loads(run("datasets", "--root", root / "DTB70", "--json").out)["datasets"]
    }
    assert found["dtb70"]["sequences"] == 1


@pytest.mark.parametrize("folder", ["UAV123", "UAV123_10fps"])
def test_of_two_folders_of_its_names_a_benchmark_is_where_its_labels_are(run: Run, tmp_path: Path, folder: str) -> None:
    for name in ("UAV123", "UAV123_10fps"):
        (tmp_path / name / "anno" / "UAV123").mkdir(parents=True)
    labels = tmp_path / folder / "anno" / "UAV123_10fps" / "boat3.txt"
    labels.parent.mkdir()
    labels.write_text("1,2,3,4\n")
    found = {r["name"]: r["found"] for r in json.loads(run("datasets", "--root", tmp_path, "--json").out)["datasets"]}
    assert (found["uav123-10fps"]["root"], found["uav123-10fps"]["sequences"]) == (str(tmp_path / folder), 1)


def test_it_is_said_in_words(run: Run, root: Path) -> None:
    lines = run("datasets", "--root", root).out.splitlines()
    assert any(line.endswith(f"found 1 sequences, 1 labels, 1 frames in {root / 'DTB70'}") for line in lines)
    assert any(f"0 frames in {root / 'uavdt'}, but " in line for line in lines)
    # of all but the three in the root and the plain folder that it is itself
    assert sum(line.strip() == "not found" for line in lines) == len(BENCHMARKS) - 4


def test_a_missing_root(run: Run, tmp_path: Path) -> None:
    assert "nowhere does not exist" in run("datasets", "--root", tmp_path / "nowhere").refused()
