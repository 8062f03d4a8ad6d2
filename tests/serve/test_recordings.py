"""Recordings that clients list and fetch, and snapshots."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest

from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import Follower
from psiamfcpp.serve.recorder import Recorder
from psiamfcpp.serve.recordings import find, listed

from .conftest import BLOB, HEIGHT, WIDTH, served, until


def write(folder: Path, name: str, *files: str) -> None:
    (folder / name).mkdir(parents=True)
    for file in files:
        (folder / name / file).write_bytes(file.encode())


def test_finished_recordings_are_listed_newest_first(tmp_path: Path) -> None:
    write(tmp_path, "20260101-120000", "video.mkv", "boxes.csv", "notes.txt")
    write(tmp_path, "20260102-120000", "video.mkv", "boxes.csv")
    write(tmp_path, "20260103-120000", "boxes.csv", ".video.77.part.mkv")  # it still runs
    (tmp_path / "file").touch()
    files = [{"name": "video.mkv", "bytes": 9}, {"name": "boxes.csv", "bytes": 9}]
    assert listed(tmp_path) == [
        {"name": "20260102-120000", "files": files},
        {"name": "20260101-120000", "files": files},
    ]
    assert listed(tmp_path / "nowhere") == []


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("one", "notes.txt"),
        ("one", "../../secret"),
        ("..", "video.mkv"),
        (".", "video.mkv"),
        ("", "video.mkv"),
        ("link", "video.mkv"),
        ("two", "video.mkv"),
    ],
)
def test_nothing_else_can_be_fetched(tmp_path: Path, name: str, file: str) -> None:
    folder = tmp_path / "recordings"
    write(folder, "one", "video.mkv", "notes.txt")
    write(tmp_path, "outside", "video.mkv")
    (tmp_path / "video.mkv").touch()
    (folder / "link").symlink_to(tmp_path / "outside")
    assert find(folder, name, file) is None
    assert find(folder, "one", "video.mkv") == folder / "one" / "video.mkv"


@pytest.fixture
def http(follower: Follower, tmp_path: Path) -> Iterator[httpx.Client]:
    """A client of a server that records."""
    pytest.importorskip("av")
    recorder = Recorder(tmp_path / "recordings", follower)
    limits = httpx.Limits(max_keepalive_connections=0)
    with served(Control(follower, recorder)) as address:
        with httpx.Client(base_url=f"http://{address}", timeout=60, limits=limits) as client:
            yield client
        recorder.stop()


def test_what_was_recorded_is_fetched_as_it_is_on_disk(http: httpx.Client, follower: Follower, tmp_path: Path) -> None:
    assert http.get("/api/recordings").json() == []
    assert http.post("/api/recording").json() == {"ok": True}
    assert http.get("/api/recordings").json() == []
    assert http.delete("/api/recording").json() == {"ok": True}
    (found,) = http.get("/api/recordings").json()
    assert [file["name"] for file in found["files"]] == ["video.mkv", "boxes.csv"]
    for file in found["files"]:
        answer = http.get(f"/api/recordings/{found['name']}/{file['name']}")
        assert answer.status_code == 200
        assert answer.content == (tmp_path / "recordings" / found["name"] / file["name"]).read_bytes()
        assert len(answer.content) == file["bytes"]
        assert answer.headers["content-disposition"].startswith("attachment")
    assert http.get("/api/recordings/nothing/video.mkv").status_code == 404
    # where it lies is nobody's business
    assert not any(str(tmp_path) in event.text for event in follower.events())
    assert any(event.text == f"recorded {found['name']}" for event in follower.events())


def test_without_recording_there_is_nothing_to_fetch(address: str) -> None:
    with httpx.Client(base_url=f"http://{address}", timeout=60) as http:
        assert http.get("/api/recordings").json() == []
        assert http.get("/api/recordings/x/video.mkv").status_code == 404


@pytest.mark.slow
def test_a_snapshot_is_the_whole_image_with_or_without_boxes(http: httpx.Client, follower: Follower) -> None:
    http.post("/api/targets", json={"box": BLOB})
    until(lambda: follower.newest and follower.newest.tracks)
    for query, has_box in (("", True), ("?boxes=false", False)):
        answer = http.get(f"/api/snapshot.jpg{query}")
        assert "attachment" in answer.headers["content-disposition"]
        image = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        assert image.shape == (HEIGHT, WIDTH, 3)
        green = int(image[80, 115, 1]) - int(image[80, 115, 2]) > 60
        assert green == has_box
