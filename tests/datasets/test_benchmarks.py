"""What holds for every benchmark: names, labels without frames, and a wrong root."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from psiamfcpp.datasets import BENCHMARKS, BenchmarkName
from psiamfcpp.errors import UserError


@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_name_is_documented_and_can_be_typed(name: str):
    assert name in get_args(BenchmarkName)
    assert BENCHMARKS[name].name == name
    assert f"`{name}`" in (Path(__file__).parents[2] / "docs" / "evaluation.md").read_text()


@pytest.mark.parametrize("name", BENCHMARKS)
def test_labels_of_a_plain_folder_stand_as_published(name: str, lay):
    root = lay({"b.txt": "0 0 0 0\nNaN NaN NaN NaN\n", "a.txt": "1,2,3,4\n"})
    labels = BENCHMARKS[name].read_labels(root)
    assert list(labels) == ["a", "b"]
    np.testing.assert_equal(labels["b"], [[0] * 4, [np.nan] * 4])


@pytest.mark.parametrize(
    ("name", "label"),
    [
        *((name, "{}.txt") for name in BENCHMARKS),
        ("uav123", "anno/UAV123/{}.txt"),
        ("uavdt", "anno/{}_gt.txt"),
        ("visdrone2018", "annotations/{}.txt"),
        ("dtb70", "{}/groundtruth_rect.txt"),
        ("otb100", "{}/groundtruth_rect.txt"),
        ("folder", "deep/{}/groundtruth_rect.txt"),
    ],
)
def test_hidden_files_beside_labels_are_passed_over(name: str, label: str, lay):
    root = lay({label.format("a"): "1,2,3,4\n", label.format("._a"): "\0\5\26\7"})
    assert list(BENCHMARKS[name].read_labels(root)) == ["a"]


@pytest.mark.parametrize(
    ("name", "missing"),
    [
        ("uav123-10fps", "anno/UAV123_10fps/<sequence>.txt"),
        ("uav123", "anno/UAV123/<sequence>.txt"),
        ("uav20l", "anno/UAV20L/<sequence>.txt"),
        ("dtb70", "<sequence>/groundtruth_rect.txt"),
        ("uavdt", "anno/<sequence>_gt.txt"),
        ("visdrone2018", "annotations/<sequence>.txt"),
        ("otb100", "<sequence>/groundtruth_rect.txt"),
        ("got10k-val", "val/list.txt"),
        ("folder", ".../groundtruth_rect.txt"),
    ],
)
def test_a_wrong_root_names_what_is_missing_and_shows_the_layout_on_one_line(name: str, missing: str, tmp_path: Path):
    benchmark = BENCHMARKS[name]
    for read in (benchmark.read, benchmark.read_labels):
        with pytest.raises(UserError, match=r"nowhere does not exist"):
            read(tmp_path / "nowhere")
        with pytest.raises(UserError, match=r"holds no sequence.*; expected layout: .*<root>/") as caught:
            read(tmp_path)
        assert f" {tmp_path}/{missing} is missing; " in str(caught.value)
        assert "\n" not in str(caught.value)


def test_an_empty_label_file_is_named(lay):
    with pytest.raises(UserError, match=r"labels .*b\.txt are empty"):
        BENCHMARKS["dtb70"].read_labels(lay({"a.txt": "1,2,3,4\n", "b.txt": "\n"}))


@pytest.mark.parametrize(
    ("name", "folder"),
    [("uav123-10fps", "UAV123@10fps"), ("dtb70", "DTB70"), ("visdrone2018", "VisDrone2018-SOT-test-dev")],
)
def test_a_folder_is_known_in_whatever_spelling(name: str, folder: str):
    assert [n for n, b in BENCHMARKS.items() if b.owns(Path("x") / folder)] == [name]
