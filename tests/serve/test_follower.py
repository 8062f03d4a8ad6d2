"""Reading and tracking in threads: commands from anywhere, streams that break, files that end."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import centre_error
from psiamfcpp.serve.follower import MAX_TARGETS, BusyError, Follower, bearing
from psiamfcpp.trackers import TargetPool, Track

from .conftest import BLOB, TIMEOUT_S, Stream, later, until


def told(follower: Follower, text: str) -> bool:
    return any(text in event.text for event in follower.events())


def track(follower: Follower, number: int) -> Track:
    assert follower.newest is not None
    return follower.newest.tracks[number]


def test_a_target_is_followed_from_box_to_stop(follower: Follower, stream: Stream) -> None:
    number, first = follower.add(BLOB)
    assert (first.box, first.state) == (BLOB, "tracking")
    stream.blobs = [(110, 85, 40, 30)]
    until(lambda: centre_error(track(follower, number).box, stream.blobs[0]) < 1)
    assert follower.newest is not None
    assert follower.newest.selected == number
    follower.remove(number)
    until(lambda: follower.newest and not follower.newest.tracks)
    assert follower.newest.selected is None
    assert [event.text for event in follower.events()] == ["target 1 is followed", "target 1 was stopped"]


def test_what_a_command_did_is_shown_when_it_returns(follower: Follower, stream: Stream) -> None:
    for _ in range(20):
        number, first = follower.add(BLOB)
        assert follower.newest is not None
        assert (follower.newest.selected, first.box) == (number, BLOB)
        follower.remove(number)
        assert number not in follower.newest.tracks


def test_loss_and_return_are_told_once_each(follower: Follower, stream: Stream) -> None:
    follower.add(BLOB)
    stream.blobs = [(600, 460, 1, 1)]
    until(lambda: track(follower, 1).state == "lost")
    stream.blobs = [BLOB]
    until(lambda: track(follower, 1).state == "tracking")
    texts = [event.text for event in follower.events()]
    assert texts == ["target 1 is followed", "target 1 was lost", "target 1 was found again"]


@pytest.mark.parametrize(
    "box", [(9000, 1, 5, 5), (1, 1, 0, 5), (float("nan"), 1, 5, 5), (-1e9, -1e9, 1, 1), (1, 1, 5, float("inf"))]
)
def test_wrong_boxes_are_refused_and_harm_nothing(follower: Follower, box: Any) -> None:
    follower.add(BLOB)
    with pytest.raises(UserError, match="box "):
        follower.add(box)
    later(follower)
    assert track(follower, 1).state == "tracking"
    assert centre_error(track(follower, 1).box, BLOB) < 1


def test_unknown_targets_are_named(follower: Follower) -> None:
    for call in (follower.remove, follower.select):
        with pytest.raises(UserError, match=r"there is no target 5: none are followed"):
            call(5)


def test_the_chosen_target_passes_on_when_it_goes(follower: Follower, stream: Stream) -> None:
    stream.blobs = [BLOB, (520, 380, 30, 40)]
    later(follower)
    follower.add(BLOB)
    follower.add((520, 380, 30, 40))
    until(lambda: follower.newest and follower.newest.selected == 2)
    follower.select(1)
    until(lambda: follower.newest and follower.newest.selected == 1)
    follower.remove(1)
    until(lambda: follower.newest and follower.newest.selected == 2)
    follower.clear()
    until(lambda: follower.newest and follower.newest.selected is None)


def test_there_is_a_limit_to_targets(follower: Follower) -> None:
    for _ in range(MAX_TARGETS):
        follower.add(BLOB)
    with pytest.raises(BusyError, match="stop one first"):
        follower.add(BLOB)


def test_a_stream_that_breaks_is_opened_again_and_keeps_its_targets(
    follower: Follower, stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psiamfcpp.serve.reader._REOPEN_S", 0.05)
    follower.add(BLOB)
    stream.broken = True
    until(lambda: told(follower, "broke off") and told(follower, "cannot be opened"))
    # commands are obeyed while no frame comes
    follower.select(1)
    stream.closed.clear()
    stream.broken = False
    later(follower)
    assert track(follower, 1).state == "tracking"
    assert stream.opened == 2
    # the same failure again and again is one event
    assert sum("cannot be opened" in event.text for event in follower.events()) == 1


@pytest.mark.slow
def test_a_file_is_played_at_its_rate_and_over_again(stream: Stream, blob_engine: Any) -> None:
    stream.live, stream.length, stream.fps = False, 10, 50.0
    with Follower(stream.open, TargetPool()) as follower:
        until(lambda: follower.newest)
        follower.add(BLOB)
        start, opened = time.monotonic(), stream.opened
        until(lambda: stream.opened >= opened + 4)
        # four rounds, the first perhaps begun, of ten frames at 50 a second
        assert time.monotonic() - start > 0.5
        until(lambda: follower.newest and not follower.newest.tracks)
        assert told(follower, "test starts again")
        assert told(follower, "all targets were stopped")


def test_commands_from_many_threads_are_all_answered(follower: Follower) -> None:
    answers: list[str] = []

    def command() -> None:
        for _ in range(20):
            try:
                follower.add(BLOB)
                follower.clear()
                answers.append("done")
            except BusyError:
                answers.append("busy")

    threads = [threading.Thread(target=command) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(600)
    assert len(answers) == 160
    assert follower.failure is None


def test_a_file_that_starts_again_while_many_commands_wait_harms_nothing(
    stream: Stream, blob_engine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psiamfcpp.serve.follower._MAX_WAITING", 0)  # every command of a client is one too many
    search = blob_engine.search_many

    def slow(*args: Any) -> Any:
        time.sleep(0.1)
        return search(*args)

    monkeypatch.setattr(blob_engine, "search_many", slow)
    stream.live, stream.length, stream.fps = False, 4, 200.0
    with Follower(stream.open, TargetPool()) as follower:
        until(lambda: follower.newest)
        opened = stream.opened
        until(lambda: follower.failure or stream.opened >= opened + 4)
        assert follower.failure is None
        with pytest.raises(BusyError, match="too many commands"):
            follower.clear()


def test_a_tracker_that_does_not_answer_is_busy_and_does_not_obey_later(
    follower: Follower, blob_engine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    follower.add(BLOB)
    begun, held, search = threading.Event(), threading.Event(), blob_engine.search

    def hold(*args: Any) -> Any:
        begun.set()
        assert held.wait(TIMEOUT_S)
        return search(*args)

    monkeypatch.setattr(blob_engine, "search", hold)
    assert begun.wait(TIMEOUT_S)
    monkeypatch.setattr("psiamfcpp.serve.follower._ANSWER_S", 0.05)
    with pytest.raises(BusyError, match="did not answer in time"):
        follower.clear()
    held.set()
    monkeypatch.setattr("psiamfcpp.serve.follower._ANSWER_S", TIMEOUT_S)
    follower.select(1)  # behind what was given up
    assert follower.newest is not None
    assert list(follower.newest.tracks) == [1]


def test_a_tracker_that_fails_ends_it_with_its_reason(
    follower: Follower, blob_engine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any) -> Any:
        raise RuntimeError("out of order")

    follower.add(BLOB)
    monkeypatch.setattr(blob_engine, "search", broken)
    until(lambda: follower.failure)
    assert str(follower.failure) == "out of order"
    with pytest.raises(BusyError, match="shutting down"):
        follower.add(BLOB)


def test_it_ends_while_its_stream_is_silent(stream: Stream, blob_engine: Any) -> None:
    before = set(threading.enumerate())
    with Follower(stream.open, TargetPool()) as follower:
        until(lambda: follower.newest)
        stream.silent = True
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize(
    ("box", "expected"),
    [
        ((310, 230, 21, 21), (0.0, 0.0)),  # centre 320, 240: half a pixel beside the axis at 319.5, 239.5
        ((629, 230, 21, 21), (30.0, 0.0)),  # 320 right of it, where half of 60 degrees is
        ((310, -90, 21, 21), (0.0, 30.0)),
        ((-11, 230, 21, 21), (-30.0, 0.0)),
    ],
)
def test_bearings(box: Any, expected: tuple[float, float]) -> None:
    image = np.zeros((480, 640, 3), np.uint8)
    found = bearing(Track(box, 1.0, "tracking"), image, 60.0)
    # half a pixel is 0.05 degrees in the middle
    assert found == pytest.approx(expected, abs=0.1)
