"""Files: paused, played from another frame, and never shown by their path."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest

from psiamfcpp import TargetPool
from psiamfcpp.errors import UserError
from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import Follower, FrameGoneError
from psiamfcpp.serve.reader import short_name
from psiamfcpp.video.source import Source, open_source

from .conftest import BLOB, ask, browse, live, served, state, until

COUNT = 60


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, blob_frame: Callable[..., Any]) -> Path:
    """Images that are recognised by the place of a blob."""
    path = tmp_path_factory.mktemp("secret place") / "frames"
    path.mkdir()
    for number in range(COUNT):
        cv2.imwrite(str(path / f"{number}.png"), blob_frame((20 + 3 * number, 80, 40, 30)))
    return path


@pytest.fixture
def player(folder: Path, blob_engine: Any) -> Iterator[Follower]:
    """Follows the images, paused."""
    with Follower(lambda tell: open_source(folder, on_event=tell), TargetPool()) as running:
        until(lambda: running.newest)
        running.pause(True)
        yield running


def shown(follower: Follower) -> int:
    """Which of the images is shown."""
    assert follower.newest is not None
    row = follower.newest.image[95, :, 0] > 200
    return (int(row.argmax()) - 20) // 3


def show(follower: Follower, frame: int) -> int:
    """Go to a frame; the number of its shot."""
    follower.seek(frame)
    until(lambda: shown(follower) == frame and follower.position == frame)
    assert follower.newest is not None
    return follower.newest.number


def test_while_paused_only_what_was_asked_for_is_shown(player: Follower) -> None:
    first = show(player, 30)
    assert show(player, 12) == first + 1
    assert show(player, 59) == first + 2
    # behind the last one is the last one
    player.seek(10**6)
    until(lambda: player.newest and player.newest.number == first + 3)
    assert shown(player) == 59
    assert show(player, 13) == first + 4
    player.pause(False)
    until(lambda: shown(player) > 13)
    assert not player.paused


@pytest.mark.slow
def test_a_target_is_followed_on_after_a_pause(folder: Path, blob_engine: Any) -> None:
    # so slowly that no machine skips a frame, or is late before the file starts again
    with Follower(lambda tell: open_source(folder, fps=2, on_event=tell), TargetPool()) as player:
        until(lambda: player.newest)
        player.pause(True)
        show(player, 10)
        player.add((50, 80, 40, 30))
        player.pause(False)
        until(lambda: shown(player) > 12)
        assert player.newest is not None
        assert player.newest.tracks[1].state == "tracking"


def test_elsewhere_there_are_no_targets_and_no_frames_of_before(player: Follower) -> None:
    before = show(player, 10)
    player.add((50, 80, 40, 30))
    show(player, 40)
    until(lambda: player.newest and not player.newest.tracks)
    assert [event.text for event in player.events()] == ["target 1 is followed", "all targets were stopped"]
    with pytest.raises(FrameGoneError):
        player.add((50, 80, 40, 30), frame=before)


def test_a_file_without_targets_starts_again_in_silence(player: Follower) -> None:
    show(player, 57)
    player.pause(False)
    until(lambda: shown(player) < 10)
    assert player.events() == []


def test_what_is_live_is_neither_paused_nor_wound(follower: Follower) -> None:
    for call in (lambda: follower.pause(True), lambda: follower.seek(3)):
        with pytest.raises(UserError, match="test is live: only files"):
            call()


def test_pages_pause_and_wind(player: Follower) -> None:
    with served(Control(player)) as address, live(address) as socket:
        source = state(socket)["source"]
        assert (source["state"], source["live"], source["frames"], source["fps"]) == ("paused", False, COUNT, 30)
        assert ask(socket, type="seek", frame=25)["ok"]
        until(lambda: state(socket)["source"]["frame"] == 25)
        assert ask(socket, type="pause", on=False)["ok"]
        until(lambda: state(socket)["source"]["state"] == "playing")
        with browse(address, headers={"X-Client": "other"}) as http:
            assert http.post("/api/pause").status_code == 409
            assert ask(socket, type="operator", take=False)["ok"]
            assert http.post("/api/pause").json() == {"ok": True}
            assert http.put("/api/position", json={"frame": 5}).json() == {"ok": True}
            until(lambda: http.get("/api/state").json()["source"]["frame"] == 5)
            assert http.put("/api/position", json={"frame": -5}).status_code == 422
            assert http.delete("/api/pause").json() == {"ok": True}


def test_no_path_of_the_server_is_told(folder: Path, blob_engine: Any, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    for number in range(5):
        (copy / f"{number}.png").write_bytes((folder / f"{number}.png").read_bytes())
    (copy / "5.png").write_bytes(b"damaged")
    with Follower(lambda tell: open_source(copy, on_event=tell), TargetPool()) as follower:
        assert follower.name == "copy"
        until(lambda: any("5.png cannot be read" in event.text for event in follower.events()))
        assert not any(str(tmp_path) in event.text for event in follower.events())


@pytest.mark.parametrize(
    ("name", "is_live", "expected"),
    [
        ("/data/flights/a.mp4", False, "a.mp4"),
        ("a.mp4", False, "a.mp4"),
        ("frames/", False, "frames"),
        ("frames/*.jpg", False, "*.jpg"),
        (".", False, Path().resolve().name),
        ("stream rtsp://user:***@host/live", True, "stream rtsp://user:***@host/live"),
    ],
)
def test_files_are_named_without_their_folder(name: str, is_live: bool, expected: str) -> None:
    assert short_name(Source(name, 30.0, None, is_live, iter(()), lambda: None)) == expected


def test_targets_drawn_while_paused_are_kept(player: Follower) -> None:
    shot = show(player, 20)
    player.ring.hold("page", shot)
    target, track = player.add((80, 80, 40, 30), frame=shot)
    assert track.box == (80, 80, 40, 30)
    assert track.box != BLOB
    until(lambda: player.newest and target in player.newest.tracks)
