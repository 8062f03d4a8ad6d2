"""What is set side by side, from where."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.report.compare import average, collect, title

from .conftest import OTHER


def test_runs_tell_their_benchmark_and_others_boxes_lie_beside_them(results: Path, dtb70: Path) -> None:
    (comparison,) = collect([results])
    assert (comparison.dataset, comparison.title, comparison.root) == ("dtb70", "DTB70", dtb70)
    assert (comparison.sequences, comparison.labels) == (["Car1", "Car2"], 10)
    by_name = {entry.tracker: entry for entry in comparison.measured}
    assert by_name.keys() == {"blob", OTHER}
    ours, other = by_name["blob"], by_name[OTHER]
    assert ours.speed is not None
    assert ours.source == f"run on {(ours.run or {})['processor']}"
    assert (other.speed, other.run, other.source) == (None, None, "result files")
    assert other.mean["otb"].figures["precision"] == 1
    assert (other.mean["otb"].invalid, other.mean["got10k"].invalid) == (1, 0)
    assert {row.tracker for row in comparison.published} == {"SiamFC++", "P-SiamFC++"}
    assert comparison.attributes["scale variation"] == ["Car1", "Car2"]
    assert comparison.frames().keys() == {"Car1", "Car2"}


@pytest.mark.parametrize("part", [".", "dtb70", "dtb70/blob"])
def test_a_part_of_the_results_will_do(results: Path, part: str) -> None:
    (comparison,) = collect([results / part])
    assert "blob" in {entry.tracker for entry in comparison.measured}


def test_boxes_of_others_need_a_benchmark(results: Path, dtb70: Path, tmp_path: Path) -> None:
    (tmp_path / "others").mkdir()
    other = shutil.move(results / "dtb70" / OTHER, tmp_path / "others" / "KCF").parent
    with pytest.raises(UserError, match=r"others holds no run .* give --dataset and --annotations"):
        collect([other])
    (comparison,) = collect([other], {"dtb70": dtb70})
    assert [entry.tracker for entry in comparison.measured] == ["KCF"]
    # beside a run no benchmark needs to be given
    (comparison,) = collect([other, results])
    assert [entry.tracker for entry in comparison.measured] == ["KCF", "blob"]


def test_labels_without_frames(results: Path, dtb70: Path) -> None:
    for sequence in ("Car1", "Car2"):
        shutil.rmtree(dtb70 / sequence / "img")
    (comparison,) = collect([results])
    assert comparison.frames() == {}


def test_labels_that_have_moved(results: Path, dtb70: Path, tmp_path: Path) -> None:
    moved = dtb70.rename(tmp_path / "moved")
    with pytest.raises(UserError, match=r"labels of dtb70 are not in .*DTB70 any more: give --dataset dtb70"):
        collect([results])
    (comparison,) = collect([results], {"dtb70": moved})
    assert comparison.root == moved


def test_what_cannot_be_compared(results: Path, dtb70: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nowhere does not exist"):
        collect([tmp_path / "nowhere"])
    shutil.copytree(results / "dtb70" / "blob", tmp_path / "again" / "blob")
    with pytest.raises(UserError, match="again holds a second tracker called blob"):
        collect([results, tmp_path / "again"])
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "S0101.txt").write_text("1,2,3,4\n")
    with pytest.raises(UserError, match="no folder holds a result of uavdt"):
        collect([results], {"uavdt": tmp_path / "labels"})
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="empty holds no result of dtb70"):
        collect([results, tmp_path / "empty"])


def test_a_missing_sequence(results: Path) -> None:
    (results / "dtb70" / OTHER / "Car2.txt").unlink()
    with pytest.raises(UserError, match=r"lacks 1 of 2 sequences, the first is Car2"):
        collect([results])
    (comparison,) = collect([results], allow_missing=True)
    assert {entry.tracker: entry.missing for entry in comparison.measured} == {"blob": 0, OTHER: 1}


def test_a_run_is_not_taken_for_another_benchmark_with_like_names(results: Path, dtb70: Path) -> None:
    comparisons = collect([results / "dtb70"], {"otb100": dtb70})
    assert [(c.dataset, [entry.tracker for entry in c.measured]) for c in comparisons] == [
        ("dtb70", [OTHER, "blob"]),
        ("otb100", [OTHER]),
    ]


def test_an_average_needs_every_benchmark(results: Path, dtb70: Path) -> None:
    comparisons = collect([results / "dtb70"], {"otb100": dtb70})
    assert average(comparisons, OTHER, "otb", "precision") == 1
    assert average(comparisons, "blob", "otb", "precision") is None


@pytest.mark.parametrize(
    ("name", "shown"), [("uav123-10fps", "UAV123@10fps"), ("uavdt", "UAVDT"), ("folder", "Own sequences")]
)
def test_titles(name: str, shown: str) -> None:
    assert title(name) == shown
