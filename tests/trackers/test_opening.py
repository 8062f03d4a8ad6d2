"""Trackers as strings: what they name, what they are called, and when they are another one."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import pytest

from psiamfcpp import Tracker, UserError, open_tracker
from psiamfcpp.trackers import TrackerOptions, choose
from psiamfcpp.trackers.opening import KINDS


def test_graphs_are_distinguished_by_their_files(tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    ("entry", "name"),
    [
        ("siamfcpp-alexnet", "siamfcpp-alexnet"),
        ("lab.trackers:Mine", "Mine"),
        ("TrackerMIL", "TrackerMIL"),
        ("TrackerNano=a/b.onnx,c.onnx", "TrackerNano"),
        ("opencv:mil", "opencv-mil"),
        ("module:lab.trackers:Mine", "Mine"),
        ("psiamfcpp-alexnet-int8,plain=true,threads=1", "psiamfcpp-alexnet-int8,plain=true"),
    ],
)
def test_names(entry: str, name: str) -> None:
    assert choose(entry).name == name


def test_another_file_or_option_is_another_tracker_but_threads_are_not(tiny_model: Path, tmp_path: Path) -> None:
    def identity(path: Path = tiny_model, **options: Any) -> dict[str, Any]:
        return choose(str(path), TrackerOptions(**options)).identity()

    assert identity()["entry"] == "tiny"
    assert identity(threads=2) == identity()
    assert identity(search_size=239) != identity()
    moved = tmp_path / "tiny.safetensors"
    moved.write_bytes(tiny_model.read_bytes())
    assert identity(moved) == identity()
    moved.write_bytes(tiny_model.read_bytes() + b" ")
    assert identity(moved) != identity()


def test_threads_reach_opencv() -> None:
    before = cv2.getNumThreads()
    try:
        choose("opencv:mil", TrackerOptions(threads=1)).open()
        assert cv2.getNumThreads() == 1
    finally:
        cv2.setNumThreads(before)


def test_keys_of_a_model_are_the_options(tiny_model: Path) -> None:
    opened: Any = open_tracker(f"{tiny_model},plain=true,search-size=239,threads=1,engine=torch")
    assert isinstance(opened, Tracker)
    assert opened.options == TrackerOptions("torch", threads=1, search_size=239, plain=True)
    # what stands in the string goes before what is given beside it
    choice = choose(f"{tiny_model},plain=false", TrackerOptions(plain=True, threads=1))
    assert choice.options == TrackerOptions(plain=False, threads=1)


def test_an_open_model_has_the_identity_of_its_choice(tiny_model: Path) -> None:
    choice = choose(f"{tiny_model},plain=true,threads=1")
    assert choice.open().identity == choice.identity()
    assert choice.open().name == "tiny"


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("siamfcpp-alexnet,depth=3", "has no option 'depth': known are engine, device, threads, search_size, plain"),
        ("siamfcpp-alexnet,plain", "'plain' is not KEY=VALUE"),
        ("siamfcpp-alexnet,plain=yes", "plain is 'yes', but true or false is expected"),
        ("siamfcpp-alexnet,threads=many", "threads is 'many', but a whole number is expected"),
        ("siamfcpp-alexnt", "did you mean 'siamfcpp-alexnet'"),
        ("nothing.at.all:Class", "'nothing.at.all:Class' cannot be opened"),
    ],
)
def test_wrong_strings_are_refused_in_one_line(entry: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as refused:
        open_tracker(entry)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_refuses_what_it_does_not_have(kind: str) -> None:
    with pytest.raises(UserError):
        open_tracker(f"{kind}:no-such-tracker")


def test_what_decides_a_workers_boxes_is_known_without_starting_it(tmp_path: Path) -> None:
    started = tmp_path / "started"
    script = tmp_path / "worker.py"
    script.write_text(f"open({str(started)!r}, 'w')")
    choice = choose(f"trax:{sys.executable} {script}")
    before = choice.identity()
    assert before == {"kind": "trax", "command": before["command"]} and len(before["command"]) == 2
    script.write_text(script.read_text() + "\n")
    assert choice.identity() != before
    assert not started.exists()
    with pytest.raises(UserError, match="worker"):
        choice.open()
    assert started.exists()
