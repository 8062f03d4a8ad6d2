"""A box that was drawn on an older frame: the target is followed from there to the newest one."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import centre_error
from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import MAX_TARGETS, BusyError, Follower, FrameGoneError

from .conftest import BLOB, Stream, ask, live, state, until


def number(follower: Follower) -> int:
    assert follower.newest is not None
    return follower.newest.number


def pass_by(follower: Follower, frames: int = 2) -> None:
    """Wait for frames that are read after now."""
    before = number(follower)
    until(lambda: number(follower) >= before + frames)


def wander(follower: Follower, stream: Stream, steps: int = 12) -> None:
    """Move the blob further than one search reaches, in steps that a tracker can follow."""
    for step in range(1, steps + 1):
        stream.blobs = [(BLOB[0] + 12 * step, BLOB[1], *BLOB[2:])]
        pass_by(follower)


def texts(follower: Follower) -> list[str]:
    return [event.text for event in follower.events()]


@pytest.mark.slow
def test_a_target_catches_up_from_the_frame_that_it_was_drawn_on(follower: Follower, stream: Stream) -> None:
    drawn_on = number(follower)
    assert follower.ring.hold("page", drawn_on)
    wander(follower, stream)
    target, first = follower.add(BLOB, frame=drawn_on)
    assert first.box == BLOB
    until(lambda: follower.newest and target in follower.newest.tracks)
    assert follower.newest is not None
    assert centre_error(follower.newest.tracks[target].box, stream.blobs[0]) < 1
    # on the newest frame alone it would have been lost, however soon it was found again
    assert texts(follower) == ["target 1 is followed"]


@pytest.mark.slow
def test_others_are_not_followed_in_older_frames_meanwhile(
    follower: Follower, stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    follower.add(BLOB)
    drawn_on = number(follower)
    follower.ring.hold("page", drawn_on)
    wander(follower, stream)
    until(lambda: centre_error(follower.newest.tracks[1].box, stream.blobs[0]) < 1)  # type: ignore[union-attr]
    follower.add(BLOB, frame=drawn_on)
    pass_by(follower)
    assert texts(follower) == ["target 1 is followed", "target 2 is followed"]


def test_a_frame_that_is_gone_is_refused(follower: Follower, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(follower.ring, "_most_bytes", 1)
    drawn_on = number(follower)
    pass_by(follower, 6)
    for frame in (drawn_on, number(follower) + 10**6):
        with pytest.raises(FrameGoneError, match="no longer kept: draw on the image as it is now"):
            follower.add(BLOB, frame=frame)
    pass_by(follower)
    assert follower.newest is not None
    assert not follower.newest.tracks


def test_a_box_replaces_another(follower: Follower, stream: Stream) -> None:
    for _ in range(MAX_TARGETS):
        follower.add(BLOB)
    with pytest.raises(BusyError):
        follower.add(BLOB)
    follower.add(BLOB, replace=3)
    until(lambda: follower.newest and follower.newest.selected == MAX_TARGETS + 1)
    assert follower.newest is not None
    assert sorted(follower.newest.tracks) == [1, 2, 4, 5, 6, 7, 8, 9]
    assert texts(follower)[-1] == "target 9 is followed, target 3 no more"


@pytest.mark.parametrize(("box", "replace"), [((9000, 1, 5, 5), 1), (BLOB, 77)])
def test_what_cannot_replace_leaves_all_as_it_was(follower: Follower, box: Any, replace: int) -> None:
    follower.add(BLOB)
    with pytest.raises(UserError):
        follower.add(box, replace=replace)
    pass_by(follower)
    assert follower.newest is not None
    assert list(follower.newest.tracks) == [1]


@pytest.mark.slow
def test_clients_draw_on_the_frame_that_they_hold(address: str, follower: Follower, stream: Stream) -> None:
    with live(address) as socket:
        drawn_on = state(socket)["frame"]
        assert ask(socket, type="hold", frame=drawn_on)["ok"]
        wander(follower, stream)
        assert ask(socket, type="start", box=BLOB, frame=drawn_on)["ok"]
        until(lambda: centre_error(follower.newest.tracks[1].box, stream.blobs[0]) < 1)  # type: ignore[union-attr]
        reply = ask(socket, type="start", point=[120, 95], frame=drawn_on, replace=1)
        assert (reply["ok"], reply["id"]) == (True, 2)
        assert reply["box"] == pytest.approx(BLOB, abs=3)
        until(lambda: list(follower.newest.tracks) == [2])  # type: ignore[union-attr]
        assert ask(socket, type="hold")["ok"]


def test_a_frame_is_held_no_longer_than_its_client_stays(address: str, follower: Follower) -> None:
    with live(address) as socket:
        assert ask(socket, type="hold", frame=state(socket)["frame"])["ok"]
        assert follower.ring._holds
    until(lambda: not follower.ring._holds)


def test_who_only_watches_holds_nothing(address: str, follower: Follower) -> None:
    with live(address) as operator, live(address) as other:
        assert ask(operator, type="start", box=BLOB)["ok"]
        reply = ask(other, type="hold", frame=state(other)["frame"])
        assert (reply["ok"], "another client is in control" in reply["error"]) == (False, True)


def test_a_hold_of_a_frame_that_is_gone_is_refused(address: str) -> None:
    with live(address) as socket:
        reply = ask(socket, type="hold", frame=10**8)
        assert (reply["ok"], "no longer kept" in reply["error"]) == (False, True)


def test_a_point_on_nothing_is_refused(http: httpx.Client, follower: Follower, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.control.find_box", lambda *_: None)
    answer = http.post("/api/targets", json={"point": [118, 94]})
    assert answer.status_code == 422
    assert answer.json() == {"error": "nothing to follow was found there: draw a box round it"}


def test_ground_stations_get_a_square_where_nothing_is_found(control: Control, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.propose.find_box", lambda *_: None)
    _, (x, y, w, h) = control.start_at("station", 300, 200)
    assert (x + (w - 1) / 2, y + (h - 1) / 2) == pytest.approx((300, 200))
    assert w == h > 4


def test_latency_and_tracker_agree_and_are_unknown_without_a_target(address: str) -> None:
    with live(address) as socket:
        told = state(socket)
        assert (told["latency_ms_median"], told["tracker_ms_median"], told["tracker_ms"]) == (None, None, None)
        assert ask(socket, type="start", box=BLOB)["ok"]
        told = until(lambda: (s := state(socket))["latency_ms_median"] is not None and s)
        assert 0 < told["tracker_ms_median"] <= told["latency_ms_median"]
        assert ask(socket, type="stop")["ok"]
        until(lambda: state(socket)["latency_ms_median"] is None)
