"""`psiamfcpp track`: results, and every way in which it can go wrong."""

from __future__ import annotations

import csv
import json
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import psiamfcpp
from psiamfcpp import TargetPool
from psiamfcpp.cli.targets import command_again
from psiamfcpp.serve.choose import Chosen
from psiamfcpp.video.source import Source, open_source
from psiamfcpp.video.writer import VideoWriter
from psiamfcpp.zoo import DEFAULT_MODEL

from .conftest import FRAMES, PATH, Run, count_frames, read_boxes

BOX = "100,80,40,30"


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    """An empty folder for what a command writes."""
    folder = tmp_path / "outputs"
    folder.mkdir()
    return folder


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_track_follows_and_writes(run: Run, blob_engine: Any, clip: Path, outputs: Path) -> None:
    files = ("--output", outputs / "o.mp4", "--boxes", outputs / "b.txt")
    ended = run("track", clip, "--box", BOX, *files, "--json")
    assert (ended.code, ended.err) == (0, "")
    result = json.loads(ended.out)
    assert result.keys() == {"version", "tracker", "source", "frames", "fps", "numbers", "boxes", "scores", "states"}
    assert result["source"] == {"name": str(clip), "width": 320, "height": 240, "fps": 25.0}
    assert (result["version"], result["tracker"]) == (psiamfcpp.__version__, DEFAULT_MODEL)
    assert result["numbers"] == list(range(FRAMES))
    assert (result["frames"], result["states"]) == (FRAMES, ["tracking"] * FRAMES)
    assert result["fps"] > 0
    assert np.array(result["boxes"]) == pytest.approx(np.array(PATH), abs=2)
    assert result["scores"][0] == 1
    assert read_boxes(outputs / "b.txt") == pytest.approx(np.array(result["boxes"]), abs=0.006)
    assert count_frames(outputs / "o.mp4") == FRAMES
    assert names(outputs) == ["b.txt", "o.mp4"]


def test_a_part_of_a_source_is_followed(run: Run, blob_engine: Any, pictures: Path, outputs: Path) -> None:
    box = ",".join(str(v) for v in PATH[2])
    part = ("--start", "#2", "--stop", "#9", "--every", "3", "--json")
    files = ("--boxes", outputs / "b.csv", "--output", outputs / "o.mov")
    result = json.loads(run("track", pictures, "--box", box, *part, *files).out)
    assert (result["frames"], result["numbers"]) == (3, [2, 5, 8])
    assert np.array(result["boxes"]) == pytest.approx(np.array(PATH[2:9:3]), abs=2)
    with (outputs / "b.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    # a folder of images plays at 30 frames per second
    assert [(row["frame"], row["seconds"], row["state"]) for row in rows] == [
        ("2", "0.067", "tracking"),
        ("5", "0.167", "tracking"),
        ("8", "0.267", "tracking"),
    ]
    assert count_frames(outputs / "o.mov") == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--start", "later"], "'later' is no moment"),
        (["--start", "#3", "--stop", "#2"], "stop #2 is not after start #3"),
        (["--start", "99"], "start 99 is after the last frame: the source has 10 frames"),
        (["--every", "0"], "every is 0"),
    ],
)
def test_a_part_without_frames_is_refused(
    run: Run, blob_engine: Any, pictures: Path, outputs: Path, options: list[str], message: str
) -> None:
    files = ("--output", outputs / "o.mp4", "--boxes", outputs / "b.txt")
    assert message in run("track", pictures, "--box", BOX, *files, *options).refused()
    assert names(outputs) == []


def test_what_is_drawn_can_be_chosen(run: Run, blob_engine: Any, pictures: Path, outputs: Path) -> None:
    frames = {}
    for name, options in {"all": [], "bare": ["--no-fps", "--no-label"], "trail": ["--trail"]}.items():
        path = outputs / f"{name}.avi"
        assert run("track", pictures, "--box", BOX, "--output", path, *options).code == 0
        with open_source(path) as video:
            frames[name] = list(video)[-1].astype(int)
    corner = (slice(0, 20), slice(0, 30))
    assert np.abs(frames["all"] - frames["bare"])[corner].max() > 100
    # the way from the first box to the last is drawn
    assert (np.abs(frames["trail"] - frames["all"]).max(axis=-1) > 60).sum() > 15


@pytest.mark.parametrize(
    "options", [[], ["--plain"], ["--search-size", "239"], ["--threads", "1", "--engine", "torch"]]
)
def test_track_runs_a_network(run: Run, tiny_model: Path, pictures: Path, outputs: Path, options: list[str]) -> None:
    ended = run("track", pictures, "--box", BOX, "--model", tiny_model, "--boxes", outputs / "b.txt", *options)
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.startswith(f"{FRAMES} frames at ")
    assert len(read_boxes(outputs / "b.txt")) == FRAMES


def test_track_says_in_how_many_frames_the_target_was_what(run: Run, blob_engine: Any, pictures: Path) -> None:
    blob_engine.peak = 0.4
    assert run("track", pictures, "--box", BOX).out.strip().endswith("tracking in 1, unsure in 9")


@pytest.mark.parametrize("box", ["-5,-5,40,30", " 100 , 80 , 40 , 30 ", "1e2,80.0,40,30"])
def test_boxes_may_be_written_in_any_way_that_numbers_are(run: Run, blob_engine: Any, clip: Path, box: str) -> None:
    assert run("track", clip, "--box", box).code == 0


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ("900,80,40,30", "lies outside the frame (320x240)"),
        ("100,80,0,0", "holds no pixel"),
        ("100,80,-40,30", "holds no pixel"),
        ("nan,80,40,30", "is not four finite numbers"),
        ("100,80,inf,30", "is not four finite numbers"),
        ("100,80,40", "box '100,80,40' is not x,y,w,h"),
        ("100,80,40,30,2", "is not x,y,w,h"),
        ("a,b,c,d", "box 'a,b,c,d' is not x,y,w,h"),
        ("100 80 40 30", "is not x,y,w,h"),
        ("", "is not x,y,w,h"),
    ],
)
def test_a_wrong_box_is_refused_and_costs_no_file(
    run: Run, tiny_model: Path, clip: Path, outputs: Path, box: str, message: str
) -> None:
    (outputs / "b.txt").write_text("1,2,3,4\n")
    files = ("--output", outputs / "o.mp4", "--boxes", outputs / "b.txt", "--overwrite")
    assert message in run("track", clip, "--box", box, "--model", tiny_model, *files, "--json").refused()
    # what an earlier run wrote is still there, and nothing else
    assert names(outputs) == ["b.txt"]
    assert (outputs / "b.txt").read_text() == "1,2,3,4\n"


def empty(folder: Path) -> Path:
    path = folder / "empty.mp4"
    path.touch()
    return path


def text(folder: Path) -> Path:
    path = folder / "text.mp4"
    path.write_text("this is no video\n" * 100)
    return path


def nothing(folder: Path) -> Path:
    (folder / "bare").mkdir()
    return folder / "bare"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda _: "missing.mp4", "missing.mp4 does not exist"),
        (lambda _: "missing/*.jpg", "matches no image"),
        (lambda _: "99", "camera 99 cannot be opened"),
        (empty, "empty.mp4 is not a video"),
        (text, "text.mp4 is not a video"),
        (nothing, "bare holds no image"),
    ],
)
def test_a_source_without_frames_is_refused(
    run: Run, tiny_model: Path, tmp_path: Path, outputs: Path, make: Callable[[Path], Any], message: str
) -> None:
    files = ("--output", outputs / "o.mp4", "--boxes", outputs / "b.txt")
    assert message in run("track", make(tmp_path), "--box", BOX, "--model", tiny_model, *files).refused()
    assert names(outputs) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--output", "missing/o.mp4"], "video missing/o.mp4 cannot be written"),
        (["--output", "o.gif"], "video o.gif has an unknown format"),
        (["--boxes", "missing/b.txt"], "boxes missing/b.txt cannot be written"),
        (["--boxes", "."], "boxes . cannot be written"),
        (["--output", "o.mp4", "--boxes", "missing/b.txt"], "missing/b.txt cannot be written"),
        (["--output", "missing/o.mp4", "--boxes", "b.txt"], "missing/o.mp4 cannot be written"),
        (["--engine", "steam"], "unknown engine 'steam'"),
        (["--threads", "0"], "threads is 0"),
        (["--search-size", "300"], "search size 300"),
        (["--model", "no-such-model"], "model 'no-such-model' is neither a file nor a shipped model"),
    ],
)
def test_a_wrong_option_is_refused_and_leaves_nothing(
    run: Run,
    tiny_model: Path,
    clip: Path,
    outputs: Path,
    options: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(outputs)
    model = [] if "--model" in options else ["--model", tiny_model]
    assert message in run("track", clip, "--box", BOX, *model, *options, "--json").refused()
    assert names(outputs) == []


@pytest.mark.slow
def test_a_video_that_is_cut_off_is_followed_as_far_as_it_goes(
    run: Run, tiny_model: Path, tmp_path: Path, outputs: Path
) -> None:
    path = tmp_path / "whole.avi"
    rng = np.random.default_rng(0)
    with VideoWriter(path, 20, (96, 64)) as writer:
        for _ in range(40):
            writer.write(rng.integers(0, 255, (64, 96, 3), dtype=np.uint8))
    cut = tmp_path / "cut.avi"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    files = ("--output", outputs / "o.mp4", "--boxes", outputs / "b.txt")
    ended = run("track", cut, "--box", "30,20,20,20", "--model", tiny_model, *files, "--json")
    assert ended.code == 2
    complaint = ended.complaint()
    assert "cut.avi is cut off" in complaint
    result = json.loads(ended.out)
    count = result["frames"]
    assert 10 < count < 30
    assert f"the {count} frames before that were followed" in complaint
    assert len(result["boxes"]) == len(read_boxes(outputs / "b.txt")) == count_frames(outputs / "o.mp4") == count
    assert names(outputs) == ["b.txt", "o.mp4"]


def test_a_damaged_image_ends_it_with_what_came_before(
    run: Run, blob_engine: Any, pictures: Path, outputs: Path
) -> None:
    (pictures / "6.png").write_bytes((pictures / "6.png").read_bytes()[:40])
    files = ("--output", outputs / "o.mkv", "--boxes", outputs / "b.txt")
    ended = run("track", pictures, "--box", BOX, *files)
    assert ended.code == 2
    assert ended.out.startswith("6 frames at ")
    assert "6.png cannot be read" in ended.complaint()
    assert read_boxes(outputs / "b.txt") == pytest.approx(np.array(PATH[:6]), abs=1.5)
    assert count_frames(outputs / "o.mkv") == 6
    assert names(outputs) == ["b.txt", "o.mkv"]


def test_a_damaged_first_image_is_refused(run: Run, blob_engine: Any, pictures: Path, outputs: Path) -> None:
    (pictures / "0.png").write_bytes(b"")
    files = ("--output", outputs / "o.mkv", "--boxes", outputs / "b.txt")
    assert "0.png cannot be read" in run("track", pictures, "--box", BOX, *files).refused()
    assert names(outputs) == []


@pytest.mark.parametrize(("owner", "method"), [(TargetPool, "update"), (Source, "__next__")])
def test_an_interruption_keeps_what_was_done(
    run: Run,
    blob_engine: Any,
    clip: Path,
    outputs: Path,
    owner: type,
    method: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    original, calls = getattr(owner, method), iter(range(1000))
    # the sixth frame does not come; the first one costs no update
    last = 4 if owner is TargetPool else 5

    def interrupted(*args: Any) -> Any:
        if next(calls) == last:
            raise KeyboardInterrupt
        return original(*args)

    monkeypatch.setattr(owner, method, interrupted)
    files = ("--output", outputs / "o.mp4", "--boxes", outputs / "b.txt")
    ended = run("track", clip, "--box", BOX, *files, "--json")
    assert (ended.code, ended.complaint()) == (130, "interrupted")
    assert json.loads(ended.out)["frames"] == 5
    monkeypatch.undo()
    assert len(read_boxes(outputs / "b.txt")) == count_frames(outputs / "o.mp4") == 5
    assert names(outputs) == ["b.txt", "o.mp4"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
@pytest.mark.parametrize("kind", ["SIGTERM", "SIGINT", "SIGHUP"])
def test_a_signal_leaves_files_that_are_whole(tmp_path: Path, outputs: Path, kind: str) -> None:
    clip = tmp_path / "long.mp4"
    with VideoWriter(clip, 25, (64, 48)) as writer:
        for number in range(1500):
            writer.write(np.full((48, 64, 3), number % 200, np.uint8))
    command = [sys.executable, "-m", "psiamfcpp", "track", str(clip), "--box", "20,20,16,12", "--threads", "1"]
    command += ["--model", "psiamfcpp-alexnet-n-int8", "-o", str(outputs / "o.mp4"), "--boxes", str(outputs / "b.txt")]
    # a test run in the background hands on ignored signals
    heard = partial(signal.signal, getattr(signal, kind), signal.SIG_DFL)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heard)
    try:
        end = time.monotonic() + 300
        while not (outputs / "b.txt").exists() or (outputs / "b.txt").read_bytes().count(b"\n") < 20:
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.05)
        # impatient, as some service managers are
        process.send_signal(getattr(signal, kind))
        if kind != "SIGINT":
            process.send_signal(getattr(signal, kind))
        _, err = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "Traceback" not in err
    assert err.strip().endswith("psiamfcpp: interrupted")
    assert names(outputs) == ["b.txt", "o.mp4"]
    assert abs(count_frames(outputs / "o.mp4") - len(read_boxes(outputs / "b.txt"))) <= 1


def test_an_interruption_before_the_first_frame_leaves_nothing(
    run: Run, blob_engine: Any, clip: Path, outputs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(TargetPool, "add", interrupted)
    files = ("--output", outputs / "o.mp4", "--boxes", outputs / "b.txt")
    ended = run("track", clip, "--box", BOX, *files, "--json")
    assert (ended.code, ended.out, ended.complaint()) == (130, "", "interrupted")
    assert names(outputs) == []


def test_several_targets_are_followed_and_written_each(
    run: Run, blob_engine: Any, blob_frame: Callable[..., Any], tmp_path: Path, outputs: Path
) -> None:
    starts = [(60.0, 60.0, 40.0, 30.0), (520.0, 380.0, 30.0, 40.0)]
    truth = [[(x + 2 * t, y - t, w, h) for t in range(6)] for x, y, w, h in starts]
    clip = tmp_path / "two.mp4"
    with VideoWriter(clip, 25, (640, 480)) as writer:
        for pair in zip(*truth, strict=True):
            writer.write(np.maximum(*(blob_frame(box, width=640, height=480) for box in pair)))
    files = ("--output", outputs / "o.mp4", "--boxes", outputs / "b.txt")
    ended = run("track", clip, "--box", "60,60,40,30", "--box", "520,380,30,40", *files, "--json")
    assert (ended.code, ended.err) == (0, "")
    result = json.loads(ended.out)
    assert [target.keys() for target in result["targets"]] == [{"boxes", "scores", "states"}] * 2
    assert result["boxes"] == result["targets"][0]["boxes"]
    assert names(outputs) == ["b.1.txt", "b.2.txt", "o.mp4"]
    for number, (target, expected) in enumerate(zip(result["targets"], truth, strict=True), start=1):
        assert np.array(target["boxes"]) == pytest.approx(np.array(expected), abs=2)
        assert read_boxes(outputs / f"b.{number}.txt") == pytest.approx(np.array(target["boxes"]), abs=0.006)
    text = run("track", clip, "--box", "60,60,40,30", "--box", "520,380,30,40").out
    assert text.strip().endswith("target 1 tracking in 6; target 2 tracking in 6")


def test_one_wrong_box_among_several_is_refused_before_anything_is_written(
    run: Run, blob_engine: Any, clip: Path, outputs: Path
) -> None:
    boxes = ("--box", BOX, "--box", "900,80,40,30", "--boxes", outputs / "b.txt")
    assert "box 900,80,40,30 lies outside" in run("track", clip, *boxes).refused()
    assert names(outputs) == []


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_without_a_box_and_a_terminal_both_ways_to_one_are_named(run: Run, clip: Path, options: list[str]) -> None:
    complaint = run("track", clip, *options).refused()
    assert "--box is missing: give x,y,w,h" in complaint
    assert "page" in complaint and "--frame FILE.png" in complaint


def test_without_the_extra_the_page_is_not_promised(run: Run, clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert "pip install 'psiamfcpp[serve]'" in run("track", clip).refused()


def test_what_is_chosen_on_the_page_is_followed_and_printed(
    run: Run, blob_engine: Any, clip: Path, outputs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, int]] = []

    def chosen(source: Source, start: int) -> Chosen:
        next(source)  # the page has read in it
        asked.append((source.name, start))
        return Chosen(3, [PATH[3]], source)

    monkeypatch.setattr("psiamfcpp.cli.targets.check_way", lambda *_: None)
    monkeypatch.setattr("psiamfcpp.cli.track.check_way", lambda *_: None)
    monkeypatch.setattr("psiamfcpp.serve.choose.choose", chosen)
    ended = run("track", clip, "--start", "#2", "--boxes", outputs / "b.txt")
    assert ended.code == 0
    assert asked == [(str(clip), 2)]
    assert ended.err.strip() == f"next time: psiamfcpp track {clip} --box 109,83,40,30 --start '#3'"
    assert read_boxes(outputs / "b.txt") == pytest.approx(np.array(PATH[3:]), abs=2)
    again = shlex.split(ended.err.partition("psiamfcpp ")[2])
    assert run(*again, "--boxes", outputs / "again.txt").code == 0
    assert (outputs / "again.txt").read_text() == (outputs / "b.txt").read_text()


def test_a_live_source_goes_on_from_the_frame_that_was_drawn_on(
    run: Run, blob_engine: Any, blob_frame: Callable[..., Any], outputs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = Source("camera 0", 30.0, None, True, iter([]), lambda: None)
    frames = [blob_frame(box) for box in PATH]
    monkeypatch.setattr("psiamfcpp.cli.track.open_source", lambda *_, **__: camera)
    monkeypatch.setattr("psiamfcpp.cli.track.check_way", lambda *_: None)
    monkeypatch.setattr("psiamfcpp.serve.choose.choose", lambda *_: Chosen(712, [PATH[2]], iter(frames[2:])))
    ended = run("track", "0", "--boxes", outputs / "b.txt")
    # of something live there is no same frame next time
    assert (ended.code, ended.err) == (0, "")
    assert read_boxes(outputs / "b.txt") == pytest.approx(np.array(PATH[2:]), abs=2)


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        (["track", "a b.mp4"], "'a b.mp4'"),
        (["track", "a b.mp4", "--start", "5", "-o", "o.mp4"], "'a b.mp4' -o o.mp4"),
        (["track", "a b.mp4", "--start=5", "--select"], "'a b.mp4'"),
        (["-m", "pytest"], "'a b.mp4'"),
    ],
)
def test_the_command_for_next_time_keeps_the_other_options(
    given: list[str], kept: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["psiamfcpp", *given])
    command = command_again("a b.mp4", [(1, 2, 3, 4), (5, 6, 7.5, 8)], "#7")
    assert command == f"psiamfcpp track {kept} --box 1,2,3,4 --box 5,6,7.5,8 --start '#7'"


def test_a_frame_is_written_with_coordinates(run: Run, clip: Path, outputs: Path) -> None:
    ended = run("track", clip, "--frame", outputs / "f.png", "--start", "#4", "--box", "112,84,40,30")
    assert (ended.code, ended.err) == (0, "")
    assert ended.out == f"frame 4 of {clip}, 320x240, with coordinates: {outputs / 'f.png'}\n"
    image = cv2.imread(str(outputs / "f.png"))
    assert image is not None
    with open_source(clip) as source:
        frame = list(source)[4]
    assert image.shape == frame.shape
    # a line every 50 pixels, and none between the fine ones
    assert abs(int(image[150, 50, 0]) - int(frame[150, 50, 0])) > 30
    assert (image[155, 55] == frame[155, 55]).all()
    # the box, as a check
    assert tuple(image[100, 112]) == (80, 200, 40)
    assert names(outputs) == ["f.png"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--frame", "f.gif"], "frame f.gif has an unknown format: name it .png or .jpg"),
        (["--frame", "f.png", "--start", "#99"], "start #99 is after the last frame"),
        (["--frame", "missing.mp4/f.png"], "cannot be written"),
    ],
)
def test_a_frame_that_cannot_be_written_is_refused(
    run: Run, clip: Path, outputs: Path, options: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(outputs)
    (outputs / "missing.mp4").touch()
    assert message in run("track", clip, *options).refused()
    assert names(outputs) == ["missing.mp4"]


def test_no_frame_replaces_the_source(run: Run, pictures: Path) -> None:
    before = (pictures / "0.png").read_bytes()
    assert "is the input" in run("track", pictures, "--frame", pictures / "0.png").refused()
    assert (pictures / "0.png").read_bytes() == before


def test_a_window_is_asked_for_where_there_is_one(
    run: Run, blob_engine: Any, clip: Path, outputs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []

    def select(_: str, image: Any, **__: Any) -> tuple[int, int, int, int]:
        seen.append(image)
        return (106, 82, 40, 30)

    for name in ("namedWindow", "destroyWindow"):
        monkeypatch.setattr(cv2, name, lambda *_: None)
    monkeypatch.setattr(cv2, "selectROI", select)
    assert run("track", clip, "--select", "--start", "#2", "--boxes", outputs / "b.txt").code == 0
    with open_source(clip) as source:
        assert (seen[0] == list(source)[2]).all()
    assert read_boxes(outputs / "b.txt") == pytest.approx(np.array(PATH[2:]), abs=2)
    monkeypatch.setattr(cv2, "selectROI", lambda *_, **__: (0, 0, 0, 0))
    assert "no box was drawn" in run("track", clip, "--select").refused()


def test_without_windows_select_says_so(
    run: Run, blob_engine: Any, clip: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: Any) -> None:
        raise cv2.error("The function is not implemented")

    monkeypatch.setattr(cv2, "namedWindow", none)
    assert "--select needs an OpenCV with windows" in run("track", clip, "--select").refused()


@pytest.mark.parametrize("name", ["o.mp4", "b.1.txt"])
def test_a_file_is_replaced_only_when_asked(run: Run, blob_engine: Any, clip: Path, outputs: Path, name: str) -> None:
    (outputs / name).write_text("keep me")
    files = ("--output", outputs / "o.mp4", "--boxes", outputs / "b.txt")
    command = ("track", clip, "--box", BOX, "--box", BOX, *files)
    assert f"{name} exists already: choose another name, or give --overwrite" in run(*command).refused()
    assert names(outputs) == [name]
    assert (outputs / name).read_text() == "keep me"
    assert run(*command, "--overwrite").code == 0
    assert (outputs / name).read_bytes() != b"keep me"


@pytest.mark.parametrize("option", ["--output", "--boxes"])
def test_no_output_replaces_the_source(run: Run, clip: Path, option: str) -> None:
    before = clip.read_bytes()
    assert "is the input" in run("track", clip, "--box", BOX, option, clip).refused()
    assert clip.read_bytes() == before
