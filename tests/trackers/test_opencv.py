"""OpenCV's trackers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.trackers import choose
from psiamfcpp.trackers.opencv import opencv_trackers


def test_opencv_follows(blob_frame: Callable[..., Any]) -> None:
    assert "TrackerMIL" in opencv_trackers()
    tracker = choose("TrackerMIL").open()
    tracker.init(blob_frame((100, 80, 40, 30)), (100, 80, 40, 30))
    # the flat blob gives it little to hold on to
    found = tracker.update(blob_frame((103, 81, 40, 30))).box
    assert found == pytest.approx([103, 81, 40, 30], abs=30)
    assert found[2:] == (40, 30)


def test_with_model_files(shared_data: Path, blob_frame: Callable[..., Any]) -> None:
    files = ",".join(
        str(shared_data.parent / "weights" / "peers" / f"nanotrackv2_{part}.onnx") for part in ("backbone", "head")
    )
    choice = choose(f"TrackerNano={files}")
    assert (choice.name, len(choice.identity()["checksum"])) == ("TrackerNano", 16)
    tracker = choice.open()
    tracker.init(blob_frame((100, 80, 40, 30)), (100, 80, 40, 30))
    assert tracker.update(blob_frame((103, 81, 40, 30))).box == pytest.approx([103, 81, 40, 30], abs=8)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("TrackerNone", "OpenCV has no tracker 'none' here: there are .*mil"),
        ("opencv:none", "OpenCV has no tracker 'none' here: there are .*mil"),
        ("opencv:KCF", "no tracker 'KCF' here: .*; it is in opencv-contrib-python-headless"),
        ("opencv:nano", "has options none: give opencv:nano,backbone=FILE,neckhead=FILE"),
        ("opencv:mil,depth=3", "has options depth: give opencv:mil$"),
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


def test_alias_and_full_form_are_one_tracker(tmp_path: Path) -> None:
    for name in ("a.onnx", "b.onnx"):
        (tmp_path / name).write_bytes(name.encode())
    a, b = str(tmp_path / "a.onnx"), str(tmp_path / "b.onnx")
    alias, full = choose(f"TrackerNano={a},{b}"), choose(f"opencv:nano,backbone={a},neckhead={b}")
    assert (alias.entry, alias.given) == (full.entry, full.given)
    # results of version 0.1 lie under the alias
    assert (alias.name, full.name) == ("TrackerNano", "opencv-nano")


def test_several_targets_have_a_tracker_each(blob_frame: Callable[..., Any]) -> None:
    first, second = (choose("opencv:mil").open() for _ in range(2))
    frame = blob_frame((100, 80, 40, 30))
    assert first.init(frame, (100, 80, 40, 30)).box == (100, 80, 40, 30)
    assert second.init(frame, (10, 10, 30, 30)).box == (10, 10, 30, 30)
    assert first.update(frame).box == pytest.approx((100, 80, 40, 30), abs=30)
