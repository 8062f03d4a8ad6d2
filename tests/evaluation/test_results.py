"""Result files as others publish them, whole and damaged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psiamfcpp.datasets.boxes import read_boxes
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.metrics import Convention, mean_scores
from psiamfcpp.evaluation.results import find, read_result, score_results

NAMES = ["car1", "car1_1", "Jogging-1"]
BOX = "10,10,20,20\n"
DATASET = ("uav123-10fps", "UAV123_10fps")
Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes files of one box below a folder; returns the folder."""

    def lay(*names: str, text: str = BOX) -> Path:
        for name in names:
            path = tmp_path / "results" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return tmp_path / "results"

    return lay


@pytest.mark.parametrize(
    ("files", "found"),
    [
        (["car1.txt", "car1_1.txt"], {"results": {"car1", "car1_1"}}),
        (["KCF/car1.txt", "ECO/car1.txt"], {"KCF": {"car1"}, "ECO": {"car1"}}),
        # pysot and others: a folder of the benchmark above or below the trackers
        (["UAV123_10fps/KCF/car1.txt", "DTB70/KCF/Car6.txt"], {"KCF": {"car1"}}),
        (["KCF/UAV123@10fps/car1.txt", "KCF/DTB70/Car6.txt"], {"KCF": {"car1"}}),
        (["uav123-10fps/car1.txt"], {"results": {"car1"}}),
        # UAV123's sequences have the same names
        (["KCF/UAV123_10fps/car1.txt", "KCF/UAV123/car1_1.txt"], {"KCF": {"car1"}}),
        (["UAV123_10fps/KCF/car1.txt", "UAV123/car1_1.txt"], {"KCF": {"car1"}}),
        # the GOT-10k toolkit, with its times
        (["KCF/car1/car1_001.txt", "KCF/car1/car1_time.txt"], {"KCF": {"car1"}}),
        (["KCF/car1.txt", "KCF/car1_time.txt", "KCF/notes.md"], {"KCF": {"car1"}}),
        # the DCF toolkits, a folder a tracker or all in one
        (["KCF/car1.mat", "KCF/car1_1.mat"], {"KCF": {"car1", "car1_1"}}),
        (["car1_KCF.mat", "car1_1_KCF.mat", "car1_ECO_HC.mat"], {"KCF": {"car1", "car1_1"}, "ECO_HC": {"car1"}}),
        # other spellings of a sequence
        (["jogging_1.txt"], {"results": {"Jogging-1"}}),
        (["Jogging.1.txt"], {"results": {"Jogging-1"}}),
        # a folder without results is said, not left out in silence
        (["KCF/car1.txt", "plots/all.png"], {"KCF": {"car1"}, "plots": set()}),
    ],
)
def test_published_layouts(write: Write, files: list[str], found: dict[str, set[str]]) -> None:
    trackers = find(write(*files), DATASET, NAMES)
    assert {name: set(by_name) for name, by_name in trackers.items()} == found
    assert all(path.is_file() for by_name in trackers.values() for path in by_name.values())


def test_a_name_spelled_exactly_goes_before_one_that_is_like_it(write: Write) -> None:
    (files,) = find(write("Car1.txt", "car1.txt"), DATASET, ["car1", "Car1"]).values()
    assert {name: path.stem for name, path in files.items()} == {"Car1": "Car1", "car1": "car1"}


def test_a_tracker_is_called_as_its_folder_is(write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write("car1.txt")
    (tmp_path / "KCF").symlink_to(folder)
    assert list(find(tmp_path / "KCF", DATASET, NAMES)) == ["KCF"]
    monkeypatch.chdir(folder)
    assert list(find(Path(), DATASET, NAMES)) == ["results"]


def test_no_results(write: Write, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nowhere does not exist"):
        find(tmp_path / "nowhere", DATASET, NAMES)
    with pytest.raises(UserError, match=r"holds no result of the labelled sequences; expected is car1\.txt"):
        find(write("KCF/other.txt"), DATASET, NAMES)


@pytest.mark.parametrize("text", ["1,2,3,4\n5,6,7,8\n", "1\t2\t3\t4\n5\t6\t7\t8", "1 2  3 4\r\n 5, 6, 7, 8 \r\n\n\n"])
def test_signs_between_numbers_and_blank_lines_at_the_end(write: Write, text: str) -> None:
    assert read_result(write("car1.txt", text=text) / "car1.txt", 2).tolist() == [[1, 2, 3, 4], [5, 6, 7, 8]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOX, r"car1\.txt have 1 rows, but 2 are needed"),
        (BOX * 3, r"car1\.txt have 3 rows, but 2 are needed"),
        ("", r"car1\.txt have 0 rows, but 2 are needed"),
        (BOX + "10,10,2", r"car1\.txt cannot be read: line 2 is '10,10,2'"),
        (BOX + "10,10,20,", r"line 2 is '10,10,20,'"),
        (BOX + "\n" + BOX, r"line 2 is ''"),
        ("7\n7\n", r"line 1 is '7'"),
        ("10,10,20,20,0.9\n" * 2, r"line 1 is '10,10,20,20,0\.9'"),
        ("x,y,w,h\n" + BOX, r"line 1 is 'x,y,w,h'"),
    ],
)
def test_damaged_results_are_named(write: Write, text: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        read_result(write("car1.txt", text=text) / "car1.txt", 2)


def test_boxes_that_are_none_repeat_the_one_before(write: Write) -> None:
    folder = write("a.txt", text="0,0,0,0\n12,10,20,20\nNaN,NaN,NaN,NaN\n12,10,-20,20\n0,0,0,0\n")
    write("b.txt", text="10,10,20,20\n" + "12,10,20,20\n" * 4)
    labels = np.array([[10, 10, 20, 20]] * 5, float)
    truth = {"a": labels, "b": labels}
    scores = score_results(truth, {name: folder / f"{name}.txt" for name in truth}, ["otb", "got10k"])
    for by_name in scores.values():
        assert by_name["a"].figures == by_name["b"].figures


def test_a_sequence_of_one_frame_is_perfect_and_a_missing_one_does_not_count(write: Write) -> None:
    folder = write("a.txt", text="0,0,0,0\n")
    labels = {"a": np.array([[10.0, 10, 20, 20]]), "gone": np.ones((7, 4))}
    scores = score_results(labels, {"a": folder / "a.txt"}, ["otb"])["otb"]
    assert list(scores) == ["a"]
    assert scores["a"].figures["auc"] == pytest.approx(20 / 21)


def test_a_sequence_without_labels_is_named(write: Write) -> None:
    folder = write("a.txt")
    with pytest.raises(UserError, match="sequence a: no row has a label"):
        score_results({"a": np.full((1, 4), np.nan)}, {"a": folder / "a.txt"}, ["got10k"])


@pytest.mark.parametrize("wrap", ["struct", "cell"])
def test_mat_files_of_the_dcf_toolkits(tmp_path: Path, wrap: str) -> None:
    io = pytest.importorskip("scipy.io")
    boxes = np.array([[1, 2, 3, 4], [5.5, 6, 7, 8]])
    result: Any = {"res": boxes, "type": "rect", "fps": 12.5, "len": 2.0}
    cell = np.empty((1, 1), object)
    cell[0, 0] = result
    io.savemat(tmp_path / "car1.mat", {"results": result if wrap == "struct" else cell})
    assert read_result(tmp_path / "car1.mat", 2).tolist() == boxes.tolist()
    with pytest.raises(UserError, match=r"car1\.mat have 2 rows, but 3 are needed"):
        read_result(tmp_path / "car1.mat", 3)


def test_mat_files_that_hold_something_else(tmp_path: Path) -> None:
    io = pytest.importorskip("scipy.io")
    path = tmp_path / "car1.mat"
    for content in (
        {"boxes": np.ones((2, 4))},
        {"results": {"res": np.ones((2, 6)), "type": "rect"}},
        {"results": {"res": np.ones((2, 4)), "type": "ivtAff"}},
        {"results": np.ones((2, 4))},
    ):
        io.savemat(path, content)
        with pytest.raises(UserError, match=r"car1\.mat cannot be read .* a field res"):
            read_result(path, 2)
    path.write_bytes(path.read_bytes()[:150])
    with pytest.raises(UserError, match=r"car1\.mat cannot be read"):
        read_result(path, 2)


@pytest.mark.parametrize(
    ("benchmark", "tracker", "precision", "auc"),
    [
        ("DTB70", "KCF", 0.468, 0.280),
        ("DTB70", "STRCF", 0.649, 0.437),
        ("DTB70", "AutoTrack", 0.716, 0.478),
        ("UAVDT", "KCF", 0.57052, 0.290),
        ("UAVDT", "STRCF", 0.629, 0.411),
        ("UAVDT", "AutoTrack", 0.718, 0.449),
    ],
)
def test_published_figures_come_out(
    shared_data: Path, benchmark: str, tracker: str, precision: float, auc: float
) -> None:
    labels = {path.stem: read_boxes(path) for path in sorted((shared_data / "anno" / benchmark).glob("*.txt"))}
    files = find(shared_data / "results", (benchmark,), labels)[tracker]
    conventions: list[Convention] = ["otb", "got10k"]
    otb, got10k = (mean_scores(s.values()) for s in score_results(labels, files, conventions).values())
    digits = len(str(precision)) - 2
    assert (round(otb.figures["precision"], digits), round(otb.figures["auc"], 3)) == (precision, auc)
    assert (otb.invalid, got10k.invalid) == ({"DTB70": 19, "UAVDT": 79}[benchmark], 0)
