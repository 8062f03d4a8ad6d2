"""Recordings: what is on disk when the server is killed, the disk is full, or the folder is gone."""

from __future__ import annotations

import contextlib
import csv
import os
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import BusyError, Follower, Shot
from psiamfcpp.serve.recorder import _WAITING, Recorder, _Recording
from psiamfcpp.trackers import TargetPool
from psiamfcpp.video.boxes import COLUMNS
from psiamfcpp.video.source import Image, open_source
from psiamfcpp.video.writer import VideoWriter

from .conftest import BLOB, HEIGHT, TIMEOUT_S, WIDTH, Stream, browse, later, served, until

pytest.importorskip("av")


@pytest.fixture
def recorder(follower: Follower, tmp_path: Path) -> Iterator[Recorder]:
    made = Recorder(tmp_path / "records", follower)
    yield made
    made.stop()


def told(follower: Follower, text: str) -> bool:
    return any(text in event.text for event in follower.events())


def count_frames(path: Path) -> int:
    with open_source(path) as source:
        return sum(1 for _ in source)


def size_of(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


@pytest.mark.slow
def test_a_recording_has_its_video_and_its_boxes(recorder: Recorder, follower: Follower, tmp_path: Path) -> None:
    follower.add(BLOB)
    recorder.start()
    assert recorder.on
    (folder,) = (tmp_path / "records").iterdir()
    # its files are there as soon as it runs
    assert (folder / "boxes.csv").read_text().startswith(",".join(COLUMNS) + "\n")
    until(lambda: len(frames_of(folder)) > 20)
    recorder.stop()
    assert sorted(path.name for path in folder.iterdir()) == ["boxes.csv", "video.mkv"]
    with open_source(folder / "video.mkv") as source:
        frames = list(source)
    assert len(frames) > 10
    assert frames[0].shape == (HEIGHT, WIDTH, 3)
    with (folder / "boxes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["target"] for row in rows} == {"1"}
    assert [float(rows[-1][name]) for name in "xywh"] == pytest.approx(BLOB, abs=1)
    # without a change of the clock, each row is later than the one before
    seconds = [float(row["seconds"]) for row in rows]
    assert seconds == sorted(seconds)


@pytest.mark.slow
def test_frames_are_on_disk_while_it_records(recorder: Recorder, follower: Follower, tmp_path: Path) -> None:
    recorder.start()
    (folder,) = (tmp_path / "records").iterdir()
    part = until(lambda: next(folder.glob(".*.part.mkv"), None))
    copy = tmp_path / "copy.mkv"

    def readable() -> bool:
        # what another process would find now, were this one killed
        shutil.copy(part, copy)
        try:
            return count_frames(copy) >= 20
        except UserError:
            return False

    until(readable)
    assert recorder.on


def shot(number: int, seconds: float) -> Shot:
    image = np.full((HEIGHT, WIDTH, 3), 10 * number, np.uint8)
    return Shot(number, image, seconds, {}, None, 0.0)


def test_an_encoder_that_is_too_slow_does_not_fall_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    write, hold = VideoWriter.write, VideoWriter.hold
    monkeypatch.setattr(VideoWriter, "write", lambda self, image: (calls.append("write"), write(self, image)))
    monkeypatch.setattr(VideoWriter, "hold", lambda self, count: (calls.append(count), hold(self, count)))
    with _Recording(tmp_path, 50.0, shot(1, 7.0)) as recording:
        recording.write(shot(1, 7.0), behind=False)
        # others wait: the frame before is shown for longer, which costs nothing
        recording.write(shot(2, 8.0), behind=True)
        assert calls == ["write", 49, "write"]
        recording.write(shot(3, 8.1), behind=False)
        assert calls[3:] == ["write"] * 5
    video = cv2.VideoCapture(str(tmp_path / "video.mkv"))
    times = []
    while video.read()[0]:
        times.append(video.get(cv2.CAP_PROP_POS_MSEC))
    assert len(times) == 7
    assert times[-1] - times[0] == pytest.approx(1100, abs=2)


@pytest.mark.slow
def test_frames_for_which_the_encoder_has_no_time_are_left_out(
    recorder: Recorder, follower: Follower, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_go_on, write = threading.Event(), VideoWriter.write

    def slow(self: VideoWriter, image: Image) -> None:
        assert may_go_on.wait(TIMEOUT_S)
        write(self, image)

    follower.add(BLOB)
    monkeypatch.setattr(VideoWriter, "write", slow)
    recorder.start()
    later(follower, 30)
    may_go_on.set()
    (folder,) = (tmp_path / "records").iterdir()
    first = frames_of(folder)[0]
    until(lambda: frames_of(folder)[-1] > first + 30)
    recorder.stop()
    # a few waited; the encoder went on with what was new
    assert sum(first <= number <= first + 28 for number in frames_of(folder)) <= 1 + _WAITING


def frames_of(folder: Path) -> list[int]:
    """Numbers of the frames that have a row."""
    return [int(line.split(",")[1]) for line in (folder / "boxes.csv").read_text().splitlines()[1:]] or [0]


def test_what_is_recorded_is_synced_to_the_disk(
    recorder: Recorder, follower: Follower, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psiamfcpp.serve.recorder._SYNC_S", 0.01)
    synced: set[int] = set()
    monkeypatch.setattr(os, "fsync", lambda file: synced.add(os.fstat(file).st_ino))
    recorder.start()
    (folder,) = (tmp_path / "records").iterdir()
    until(lambda: {path.stat().st_ino for path in folder.iterdir()} <= synced)


@pytest.mark.slow
def test_a_full_disk_keeps_what_was_recorded(
    recorder: Recorder, follower: Follower, stream: Stream, tmp_path: Path
) -> None:
    resource = pytest.importorskip("resource")
    rng = np.random.default_rng(0)
    stream._draw = lambda *_, **__: rng.integers(0, 60, (HEIGHT, WIDTH, 3), dtype=np.uint8)  # fills the disk soon
    recorder.start()
    (folder,) = (tmp_path / "records").iterdir()
    part = until(lambda: next(folder.glob(".*.part.mkv"), None))
    until(lambda: size_of(part) > 1_000_000)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_of(part) + 100_000, before[1]))
    try:
        until(lambda: told(follower, "recording ended: "))
        until(lambda: not recorder.on)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert told(follower, f"what was written until then is in {folder / 'video.mkv'}")
    assert sorted(path.name for path in folder.iterdir()) == ["boxes.csv", "video.mkv"]
    assert count_frames(folder / "video.mkv") > 5
    # and the next one begins anew
    recorder.start()
    assert recorder.on


def test_a_stream_that_comes_back_with_another_size_is_recorded_on(
    recorder: Recorder, follower: Follower, stream: Stream, tmp_path: Path
) -> None:
    follower.add(BLOB)
    recorder.start()
    (first,) = (tmp_path / "records").iterdir()
    until(lambda: len(frames_of(first)) > 3)
    draw = stream._draw
    stream._draw = lambda box, width, height: draw(box, width=320, height=240)
    second = until(lambda: next((each for each in (tmp_path / "records").iterdir() if each != first), None))
    until(lambda: (second / "boxes.csv").exists() and len(frames_of(second)) > 3)
    assert recorder.on
    recorder.stop()
    recorder.stop()
    for folder, shape in ((first, (HEIGHT, WIDTH, 3)), (second, (240, 320, 3))):
        with open_source(folder / "video.mkv") as source:
            assert next(source).shape == shape
    assert told(follower, "the stream changed its size to 320x240")


def test_whatever_ends_a_recording_is_told_and_the_next_one_begins(
    recorder: Recorder, follower: Follower, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("out of\norder")

    with monkeypatch.context() as broken_writer:
        broken_writer.setattr(VideoWriter, "write", broken)
        recorder.start()
        until(lambda: told(follower, "recording ended: out of order"))
        until(lambda: not recorder.on)
    recorder.start()
    recorder.start()
    assert recorder.on


def test_two_who_start_at_once_record_once(recorder: Recorder, follower: Follower, tmp_path: Path) -> None:
    both = threading.Barrier(8)

    def begin() -> None:
        both.wait(TIMEOUT_S)
        recorder.start()

    threads = [threading.Thread(target=begin) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(TIMEOUT_S)
    assert len(list((tmp_path / "records").iterdir())) == 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs limits on files")
def test_without_a_file_left_a_recording_is_refused(recorder: Recorder, follower: Follower, tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    later(follower)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    probe = os.open(os.devnull, os.O_RDONLY)
    filled = []
    # from none to those that a recording needs
    for spare in range(4):
        resource.setrlimit(resource.RLIMIT_NOFILE, (probe + 20, before[1]))
        try:
            with contextlib.suppress(OSError):
                while True:
                    filled.append(os.open(os.devnull, os.O_RDONLY))
            for _ in range(spare):
                os.close(filled.pop())
            with contextlib.suppress(UserError):
                recorder.start()
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
            while filled:
                os.close(filled.pop())
        recorder.stop()
    os.close(probe)
    recorder.start()
    assert recorder.on


def test_a_folder_that_is_gone_is_answered(follower: Follower, recorder: Recorder, tmp_path: Path) -> None:
    (tmp_path / "records").rmdir()
    with served(Control(follower, recorder)) as address, browse(address) as http:
        answer = http.post("/api/recording")
        assert answer.status_code == 422
        assert "cannot be written: No such file" in answer.json()["error"]
        assert http.get("/api/state").json()["recording"] is False
        (tmp_path / "records").mkdir()
        assert http.post("/api/recording").json() == {"ok": True}
        assert http.get("/api/state").json()["recording"] is True


def test_a_recording_that_cannot_begin_leaves_nothing(follower: Follower, recorder: Recorder, tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        with pytest.raises(UserError, match=r"boxes\.csv cannot be written"):
            recorder.start()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not recorder.on
    assert list((tmp_path / "records").iterdir()) == []


def test_without_a_frame_it_is_not_yet_possible(stream: Stream, blob_engine: object, tmp_path: Path) -> None:
    stream.silent = True
    with Follower(stream.open, TargetPool()) as follower:
        recorder = Recorder(tmp_path, follower)
        with pytest.raises(BusyError, match="no frame"):
            recorder.start()
        assert not recorder.on
