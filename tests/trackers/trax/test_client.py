from __future__ import annotations

import gc
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.trackers.trax import TraxTracker, open_trax, trax_files, trax_name

SCRIPT = Path(__file__).with_name("worker_script.py")
FRAME = np.zeros((60, 80, 3), np.uint8)
BOX = (10.5, 12.0, 20.0, 16.0)

Open = Callable[..., TraxTracker]


def command(*arguments: str) -> str:
    return shlex.join([sys.executable, str(SCRIPT), *arguments])


@pytest.fixture
def opened() -> Iterator[Open]:
    """Opens workers in a mode of `worker_script.py`; all are closed after the test."""
    trackers: list[TraxTracker] = []

    def start(*arguments: str, frame_seconds: float = 120, start_seconds: float = 120) -> TraxTracker:
        tracker = open_trax(command(*arguments), frame_seconds=frame_seconds, start_seconds=start_seconds)
        trackers.append(tracker)
        return tracker

    yield start
    for tracker in trackers:
        tracker.close()


def descendants() -> list[str]:
    """Command lines of all living processes that run the worker script."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            line = (folder / "cmdline").read_bytes()
            dead = "Z" in (folder / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue
        if str(SCRIPT).encode() in line and not dead:
            found.append(line.decode())
    return found


def eventually(condition: Callable[[], bool], seconds: float = 120) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


@pytest.mark.parametrize("version", ["1", "3", "4"])
def test_follows_a_target_in_every_version_of_the_protocol(opened: Open, version: str) -> None:
    tracker = opened("good", version)
    assert tracker.init(FRAME, BOX).box == BOX
    for shift in (1, 2, 3):
        track = tracker.update(FRAME)
        assert track.box == (BOX[0] + shift, *BOX[1:])
        assert track.score is None and track.state is None


@pytest.mark.parametrize("mode", ["good", "one-target"])
def test_a_second_target_starts_afresh(opened: Open, mode: str) -> None:
    tracker = opened(mode)
    tracker.init(FRAME, BOX)
    tracker.update(FRAME)
    assert tracker.init(FRAME, (30, 30, 8, 9)).box == (30, 30, 8, 9)
    assert tracker.update(FRAME).box == (31, 30, 8, 9)


@pytest.mark.parametrize("version", ["1", "4"])
def test_one_worker_can_follow_targets_in_turn(version: str) -> None:
    words = shlex.split(command("good", version))
    tracker = TraxTracker(words, "good", {}, label="good", environment={}, reuse=True)
    try:
        tracker.init(FRAME, BOX)
        assert tracker._worker is not None
        process = tracker._worker._process.pid
        tracker.update(FRAME)
        assert tracker.init(FRAME, (30, 30, 8, 9)).box == (30, 30, 8, 9)
        assert tracker.update(FRAME).box == (31, 30, 8, 9)
        assert tracker._worker._process.pid == process
    finally:
        tracker.close()


@pytest.mark.parametrize("images", ["memory;", "buffer;", "data", "path;", "url", "path;memory;"])
def test_the_frame_arrives_without_loss_in_every_kind_of_image(opened: Open, images: str) -> None:
    frame = np.random.default_rng(0).integers(0, 256, (60, 80, 3), np.uint8)
    frame[0, 0] = (30, 20, 10)
    tracker = opened("pixel", "4", images)
    assert tracker.init(frame, BOX).box == (10, 20, 30, 1)
    frame[0, 0] = (33, 22, 11)
    assert tracker.update(frame).box == (11, 22, 33, 1)


@pytest.mark.parametrize(
    ("mode", "box"),
    [("polygon", (10.5, 12, 20, 16)), ("mask", (10, 12, 20, 16))],
)
def test_the_first_box_is_sent_in_the_workers_kind_of_region(
    opened: Open, mode: str, box: tuple[float, float, float, float]
) -> None:
    assert opened(mode).init(FRAME, BOX).box == box


@pytest.mark.parametrize(
    ("mode", "box"),
    [
        # corners (10, 20), (30, 20), (30, 50), (10, 50.5)
        ("polygon-answer", (10, 20, 20, 30.5)),
        # at (5, 6), four columns and three rows: .....XX..XX. leaves columns 1 and 2 of rows 1 and 2
        ("mask-answer", (6, 7, 2, 2)),
    ],
)
def test_answers_may_be_polygons_and_masks(opened: Open, mode: str, box: tuple[float, float, float, float]) -> None:
    tracker = opened(mode)
    tracker.init(FRAME, BOX)
    tracker.update(FRAME)
    assert tracker.update(FRAME).box == box


def test_score_and_state_are_the_workers_properties(opened: Open) -> None:
    tracker = opened("properties")
    tracker.init(FRAME, BOX)
    tracker.update(FRAME)
    track = tracker.update(FRAME)
    assert (track.score, track.state) == (0.25, "unsure")


def test_unknown_properties_are_not_invented(opened: Open) -> None:
    tracker = opened("bad-properties")
    tracker.init(FRAME, BOX)
    tracker.update(FRAME)
    track = tracker.update(FRAME)
    assert (track.score, track.state) == (None, None)


def test_a_special_region_is_a_lost_target_that_stays_where_it_was(opened: Open) -> None:
    tracker = opened("lost")
    tracker.init(FRAME, BOX)
    before = tracker.update(FRAME).box
    track = tracker.update(FRAME)
    assert (track.box, track.state) == (before, "lost")


def test_output_of_the_tracker_itself_is_passed_over(opened: Open) -> None:
    for mode in ("prints-first", "prints"):
        tracker = opened(mode)
        tracker.init(FRAME, BOX)
        tracker.update(FRAME)
        assert tracker.update(FRAME).box == (BOX[0] + 2, *BOX[1:])


@pytest.mark.parametrize(
    ("mode", "parts"),
    [
        ("dies", ["ended with exit code 7 in frame 3", "first line | MemoryError: not enough"]),
        ("killed", ["was killed by SIGSEGV in frame 3"]),
        ("quits", ['quit in frame 3 (target "gone")']),
        ("forks", ["ended with exit code 5 in frame 3"]),
        ("garbage", ["answered nonsense in frame 3", "'what,is,this,now' is no region"]),
        ("nan", ["answered nonsense in frame 3", "not finite"]),
        ("negative", ["answered nonsense in frame 3", "negative side"]),
        ("three", ["answered nonsense in frame 3", "3 numbers"]),
        ("no-region", ["answered nonsense in frame 3", "0 regions where one is due"]),
        ("two-regions", ["answered nonsense in frame 3", "2 regions where one is due"]),
        ("hello-again", ["sent 'hello' in frame 3 where state was due"]),
        ("no-name", ["answered nonsense in frame 3", "has no name"]),
        ("huge-line", ["wrote a line of more than 8 MiB in frame 3"]),
    ],
)
def test_a_fault_of_the_worker_is_one_line_that_names_it(opened: Open, mode: str, parts: list[str]) -> None:
    tracker = opened(mode)
    tracker.init(FRAME, BOX)
    tracker.update(FRAME)
    with pytest.raises(UserError) as caught:
        tracker.update(FRAME)
    text = str(caught.value)
    assert "\n" not in text
    for part in ["trax:", "worker_script.py", *parts]:
        assert part in text
    # the next target gets a worker of its own
    with pytest.raises(UserError, match="call init"):
        tracker.update(FRAME)
    assert tracker.init(FRAME, BOX).box == BOX


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["hangs", "hangs-deaf", "endless-lines"])
def test_a_worker_that_hangs_is_ended_after_the_time_out(opened: Open, mode: str) -> None:
    tracker = opened(mode)
    tracker.init(FRAME, BOX)
    tracker.update(FRAME)
    # only now: an answer that does come may take a slow machine longer
    tracker._frame_seconds = 0.5
    with pytest.raises(UserError, match=r"gave no answer in frame 3 in 0.5 s") as caught:
        tracker.update(FRAME)
    last_words = {"hangs": "still thinking", "endless-lines": "chatter | chatter"}
    assert last_words.get(mode, "3 in 0.5 s") in str(caught.value)
    assert eventually(lambda: not any(mode in line for line in descendants()))


@pytest.mark.slow
def test_a_worker_that_does_not_read_cannot_block_us(opened: Open) -> None:
    tracker = opened("deaf", frame_seconds=0.5)
    large = np.zeros((720, 1280, 3), np.uint8)
    with pytest.raises(UserError, match=r"gave no answer in frame 1 in 0\.5 s"):
        tracker.init(large, BOX)


def test_a_second_answer_to_one_frame_is_refused(opened: Open) -> None:
    tracker = opened("two-states")
    tracker.init(FRAME, BOX)
    tracker.update(FRAME)
    tracker.update(FRAME)
    with pytest.raises(UserError, match="second state for one frame"):
        tracker.update(FRAME)


@pytest.mark.parametrize(
    ("mode", "text"),
    [
        ("dies-at-start", "ended with exit code 3 at its start; it printed last: ImportError: no module"),
        ("not-trax", "ended with exit code 0 at its start; it printed last: Usage: this is no TraX tracker"),
        ("silent", "gave no answer at its start in 0.5 s"),
        ("version", "says hello with a version that is no number"),
        ("channels", "it needs the image channels color, depth"),
        ("regions", "it needs regions as ellipse"),
    ],
)
def test_a_worker_that_cannot_be_used_is_refused_at_once(opened: Open, mode: str, text: str) -> None:
    with pytest.raises(UserError, match=text):
        opened(mode, start_seconds=0.5 if mode == "silent" else 120)


def test_images_that_we_cannot_send_are_refused(opened: Open) -> None:
    with pytest.raises(UserError, match="takes images by hologram"):
        opened("good", "4", "hologram")


@pytest.mark.parametrize(
    ("text", "part"),
    [("", "needs a command"), ("'", "check its quotes"), ("no-such-program-here -x", "no program 'no-such-program-")],
)
def test_commands_that_cannot_be_started(text: str, part: str) -> None:
    with pytest.raises(UserError, match=part):
        open_trax(text)


def test_refuses_frames_and_boxes_before_they_reach_the_worker(opened: Open) -> None:
    tracker = opened("good")
    with pytest.raises(UserError, match="no image"):
        tracker.init(FRAME[..., 0], BOX)
    with pytest.raises(UserError, match="outside the frame"):
        tracker.init(FRAME, (100, 10, 5, 5))
    with pytest.raises(UserError, match="call init"):
        tracker.update(FRAME)
    assert tracker.init(FRAME, BOX).box == BOX


def test_name_and_identity_do_not_know_the_folder(tmp_path: Path) -> None:
    copies = []
    for folder in ("a", "b"):
        path = tmp_path / folder / "tracker.py"
        path.parent.mkdir()
        path.write_bytes(SCRIPT.read_bytes())
        copies.append(path)
    commands = [shlex.join([sys.executable, str(path), "good"]) for path in copies]
    assert trax_files(commands[0]) == [copies[0]]
    assert trax_name(commands[0]) == "tracker"
    assert trax_name("siamfc --fast") == "siamfc"
    first, second = (open_trax(text) for text in commands)
    copies[1].write_text(copies[1].read_text() + "\n# another tracker\n")
    third = open_trax(commands[1])
    for tracker in (first, second, third):
        tracker.close()
        tracker.close()
    assert first.identity == second.identity
    assert first.identity != third.identity
    assert first.name == "tracker"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_tracker_that_nobody_closed_ends_its_worker() -> None:
    tracker = open_trax(command("good", "4", "memory;forgotten;"))
    tracker.init(FRAME, BOX)
    assert any("forgotten" in line for line in descendants())
    del tracker
    gc.collect()
    assert eventually(lambda: not any("forgotten" in line for line in descendants()))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("mode", ["forks", "forks-and-goes-on"])
def test_nothing_that_a_worker_forked_outlives_it(opened: Open, mode: str) -> None:
    # a process that is forked while the others are killed is easily missed
    for _ in range(5):
        tracker = opened(mode)
        tracker.init(FRAME, BOX)
        tracker.update(FRAME)
        if mode == "forks":
            with pytest.raises(UserError, match="exit code 5"):
                tracker.update(FRAME)
        else:
            tracker.update(FRAME)
            tracker.close()
    assert eventually(lambda: not any(mode in line for line in descendants()))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("mode", ["hangs-deaf", "forks-and-goes-on"])
def test_nothing_outlives_us_when_we_are_killed(tmp_path: Path, mode: str) -> None:
    us = f"""
import numpy as np, sys
from psiamfcpp.trackers.trax import open_trax
tracker = open_trax({command(mode, "4", "path;")!r})
frame = np.zeros((60, 80, 3), np.uint8)
tracker.init(frame, {BOX})
tracker.update(frame)
if {mode == "forks-and-goes-on"}:
    tracker.update(frame)
print(tracker._worker.folder, flush=True)
tracker.update(frame)
print("ready", flush=True)
sys.stdin.read()
"""
    process = subprocess.Popen([sys.executable, "-c", us], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    folder = Path(process.stdout.readline().strip())
    assert folder.is_dir()
    assert any(mode in line for line in descendants())
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert eventually(lambda: not any(mode in line for line in descendants()))
    assert eventually(lambda: not folder.exists())
