"""Trackers of every kind, opened and refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.trackers import ModelOptions, choose, opencv_trackers

FRAME = np.zeros((48, 64, 3), np.uint8)
FRAME[..., 0] = 200  # blue
BOX = np.array([10.0, 12.0, 20.0, 16.0])

MODULE = """
import numpy as np
class Standing:
    def init(self, image, box):
        self.image, self.box = image, box
    def update(self, image):
        return self.box
class Bgr(Standing):
    image_format = "bgr"
class Pil(Standing):
    image_format = "pil"
class Grey(Standing):
    image_format = "grey"
class NoUpdate:
    def init(self, image, box): pass
class NeedsAnArgument:
    def __init__(self, weights): pass
class Fails(Standing):
    def update(self, image):
        raise ValueError("no such thing")
class Nothing(Standing):
    def update(self, image):
        return None
class Talks(Standing):
    def __init__(self):
        print("loading")
    def update(self, image):
        print("looking")
        return self.box
class Spoils(Standing):
    def init(self, image, box):
        box[:] = -1
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module of trackers in the working directory."""
    name = f"trackers_of_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    return name


@pytest.mark.parametrize(("name", "blue_at"), [("Standing", 2), ("Bgr", 0), ("Pil", 2)])
def test_a_class_gets_the_colours_that_it_asks_for(module: str, name: str, blue_at: int) -> None:
    if name == "Pil":
        pytest.importorskip("PIL")
    tracker: Any = choose(f"{module}:{name}").open()
    tracker.init(FRAME, BOX)
    image = tracker._tracker.image
    assert isinstance(image, np.ndarray) is (name != "Pil")
    assert np.asarray(image).shape == (48, 64, 3)
    assert np.asarray(image)[0, 0].argmax() == blue_at
    assert np.asarray(tracker.update(FRAME)).tolist() == BOX.tolist()


def test_a_class_cannot_spoil_the_labels(module: str) -> None:
    box = BOX.copy()
    choose(f"{module}:Spoils").open().init(FRAME, box)
    assert box.tolist() == BOX.tolist()


def test_what_a_class_prints_does_not_mix_with_results(module: str, capsys: pytest.CaptureFixture[str]) -> None:
    tracker = choose(f"{module}:Talks").open()
    tracker.init(FRAME, BOX)
    tracker.update(FRAME)
    assert capsys.readouterr() == ("", "loading\nlooking\n")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Missing", "cannot be opened"),
        ("NeedsAnArgument", "cannot be opened .*weights.*built without arguments"),
        ("NoUpdate", r"has no update\(\)"),
        ("Grey", "image_format 'grey': known are rgb, bgr, pil"),
    ],
)
def test_a_class_that_cannot_be_used(module: str, name: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        choose(f"{module}:{name}").open()
    with pytest.raises(UserError, match=r"'nowhere_at_all:Class' cannot be opened \(ModuleNotFoundError"):
        choose("nowhere_at_all:Class").open()


@pytest.mark.parametrize(
    ("name", "message"),
    [("Fails", r"failed in update\(\) \(ValueError: no such thing\)"), ("Nothing", "returned None: a box x,y,w,h")],
)
def test_a_class_that_fails_is_named(module: str, name: str, message: str) -> None:
    tracker = choose(f"{module}:{name}").open()
    tracker.init(FRAME, BOX)
    with pytest.raises(UserError, match=message):
        tracker.update(FRAME)


# OpenCV


def test_graphs_are_told_apart_by_their_files(tmp_path: Path) -> None:
    # nothing is opened yet: any files will do
    folders = [tmp_path / place / "tiny" for place in ("here", "there")]
    for folder in folders:
        folder.mkdir(parents=True)
        for name in ("search.onnx", "template.onnx"):
            (folder / name).write_bytes(b"graph")
    first, same = (choose(str(folder)) for folder in folders)
    assert (first.name, len(first.checksum)) == ("tiny", 16)
    assert first.identity() == same.identity()
    (folders[1] / "search.onnx").write_bytes(b"graph0")
    assert choose(str(folders[1])).identity() != first.identity()


def test_opencv_follows(blob_frame: Callable[..., Any]) -> None:
    assert "TrackerMIL" in opencv_trackers()
    tracker = choose("TrackerMIL").open()
    tracker.init(blob_frame((100, 80, 40, 30)), np.array([100.0, 80.0, 40.0, 30.0]))
    # the flat blob gives it little to hold on to
    found = np.asarray(tracker.update(blob_frame((103, 81, 40, 30))))
    assert found == pytest.approx([103, 81, 40, 30], abs=30)
    assert found[2:].tolist() == [40, 30]


def test_opencv_with_model_files(shared_data: Path, blob_frame: Callable[..., Any]) -> None:
    files = ",".join(
        str(shared_data.parent / "weights" / "peers" / f"nanotrackv2_{part}.onnx") for part in ("backbone", "head")
    )
    choice = choose(f"TrackerNano={files}")
    assert (choice.name, len(choice.checksum)) == ("TrackerNano", 16)
    tracker = choice.open()
    tracker.init(blob_frame((100, 80, 40, 30)), np.array([100.0, 80.0, 40.0, 30.0]))
    assert np.asarray(tracker.update(blob_frame((103, 81, 40, 30)))) == pytest.approx([103, 81, 40, 30], abs=8)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("TrackerNone", "OpenCV has no 'TrackerNone' here: there are .*TrackerMIL"),
        ("TrackerNano", r"has 0 model files: give TrackerNano=BACKBONE\.onnx,NECKHEAD\.onnx"),
        ("TrackerMIL=a.onnx", "has 1 model files: give TrackerMIL$"),
        ("TrackerVit=nowhere.onnx", r"model file 'nowhere\.onnx' of TrackerVit does not exist"),
    ],
)
def test_opencv_refuses(entry: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        choose(entry).open()


def test_opencv_files_that_are_no_models(tmp_path: Path) -> None:
    (tmp_path / "a.onnx").write_bytes(b"no model")
    with pytest.raises(UserError, match=r"OpenCV cannot open TrackerVit .*: check its model files"):
        choose(f"TrackerVit={tmp_path / 'a.onnx'}").open()


# what a tracker is called, and when it is another one


@pytest.mark.parametrize(
    ("entry", "name"),
    [
        ("siamfcpp-alexnet", "siamfcpp-alexnet"),
        ("lab.trackers:Mine", "Mine"),
        ("TrackerMIL", "TrackerMIL"),
        ("TrackerNano=a/b.onnx,c.onnx", "TrackerNano"),
    ],
)
def test_names(entry: str, name: str) -> None:
    assert choose(entry).name == name


def test_another_file_or_option_is_another_tracker_but_threads_are_not(tiny_model: Path, tmp_path: Path) -> None:
    def identity(path: Path = tiny_model, **options: Any) -> dict[str, Any]:
        return choose(str(path), ModelOptions(**options)).identity()

    assert identity()["entry"] == "tiny"
    assert identity(threads=2) == identity()
    assert identity(search_size=239) != identity()
    moved = tmp_path / "tiny.safetensors"
    moved.write_bytes(tiny_model.read_bytes())
    assert identity(moved) == identity()
    moved.write_bytes(tiny_model.read_bytes() + b" ")
    assert identity(moved) != identity()


def test_threads_reach_opencv(module: str) -> None:
    before = cv2.getNumThreads()
    try:
        choose(f"{module}:Standing", ModelOptions(threads=1)).open()
        assert cv2.getNumThreads() == 1
    finally:
        cv2.setNumThreads(before)
