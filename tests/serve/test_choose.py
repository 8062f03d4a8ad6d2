"""Choosing targets before a source is followed: what the page's server does, and what it refuses."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import cv2
import httpx
import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.serve.choose import Chosen, _Live, choose
from psiamfcpp.video.source import Source, open_source
from psiamfcpp.video.writer import VideoWriter

from .conftest import BLOB, HEIGHT, TIMEOUT_S, WIDTH, Stream, until

COUNT = 130


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory, blob_frame: Callable[..., Any]) -> Path:
    """A blob that moves by a pixel per frame."""
    path = tmp_path_factory.mktemp("clip") / "moving.mp4"
    ground = blob_frame(None, width=480, height=320)
    with VideoWriter(path, 25, (480, 320)) as writer:
        for number in range(COUNT):
            frame = ground.copy()
            frame[50:80, 60 + number : 100 + number] = 255
            writer.write(frame)
    return path


def left_edge(image: Any) -> int:
    return int(np.argmax(np.asarray(image)[65, :, 0] > 150))


class Choosing:
    """`choose` in a thread, and a client of its server."""

    def __init__(self, source: Source, start: int = 0):
        self.address, self.result, self.error = "", None, None
        ready = threading.Event()

        def shown(address: str) -> None:
            self.address = address
            ready.set()

        def run() -> None:
            try:
                self.result = choose(source, start, shown)
            except BaseException as error:
                self.error = error

        self.result: Chosen | None
        self.error: BaseException | None
        self.thread = threading.Thread(target=run)
        self.thread.start()
        assert ready.wait(60)
        where = urlsplit(self.address)
        assert where.hostname == "127.0.0.1"
        self.token = parse_qs(where.query)["token"][0]
        limits = httpx.Limits(max_keepalive_connections=0)
        self.http = httpx.Client(base_url=f"http://{where.netloc}", timeout=60, limits=limits)

    def enter(self) -> None:
        session = self.http.post("/api/enter", json={"token": self.token}).json()["session"]
        self.http.headers["Authorization"] = f"Bearer {session}"

    def frame(self, **query: int) -> tuple[int, Any, httpx.Response]:
        answer = self.http.get("/api/frame", params=query)
        assert answer.status_code == 200, answer.text
        image = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)
        return int(answer.headers["X-Frame"]), image, answer

    def end(self) -> None:
        if self.thread.is_alive():
            if "Authorization" not in self.http.headers:
                self.enter()
            self.http.post("/api/choose", json={"frame": self.frame()[0], "boxes": [[1, 1, 9, 9]]})
        self.thread.join(60)
        assert not self.thread.is_alive()
        self.http.close()


@pytest.fixture
def choosing(clip: Path) -> Iterator[Choosing]:
    with open_source(clip) as source:
        running = Choosing(source)
        yield running
        running.end()


@pytest.mark.slow
def test_what_is_chosen_is_returned_with_the_frames_from_there(choosing: Choosing) -> None:
    choosing.enter()
    about = choosing.http.get("/api/source").json()
    assert about == {
        "name": "moving.mp4",
        "live": False,
        "fps": 25,
        "frames": COUNT,
        "start": 0,
        "width": 480,
        "height": 320,
    }
    number, image, _ = choosing.frame(number=40)
    assert (number, left_edge(image)) == (40, 100)
    boxes = [[100, 50, 40, 30], [10.5, 20, 30, 30]]
    assert choosing.http.post("/api/choose", json={"frame": 40, "boxes": boxes}).json() == {"ok": True}
    choosing.thread.join(60)
    chosen = choosing.result
    assert chosen is not None
    assert (chosen.start_frame, chosen.boxes) == (40, [(100, 50, 40, 30), (10.5, 20, 30, 30)])
    assert [left_edge(next(chosen.frames)) for _ in range(3)] == [100, 101, 102]


def test_a_frame_far_ahead_is_reached_by_stages_and_back_at_once(choosing: Choosing) -> None:
    choosing.enter()
    reached = []
    while not reached or reached[-1] != 120:
        number, image, _ = choosing.frame(number=120)
        assert left_edge(image) == 60 + number
        reached.append(number)
    assert len(reached) > 1
    assert reached == sorted(set(reached))
    for back in (60, 3, 21):
        assert choosing.frame(number=back)[0] == back


@pytest.mark.slow
def test_behind_the_end_is_the_last_frame(choosing: Choosing) -> None:
    choosing.enter()
    answer = None
    number = -1
    for _ in range(10):
        number, image, answer = choosing.frame(number=10_000)
    assert answer is not None
    assert (number, left_edge(image), answer.headers["X-Count"]) == (COUNT - 1, 60 + COUNT - 1, str(COUNT))
    assert choosing.frame(number=5)[0] == 5


def test_a_tap_has_its_box_proposed_or_is_answered_that_there_is_none(
    choosing: Choosing, monkeypatch: pytest.MonkeyPatch
) -> None:
    choosing.enter()
    ask = choosing.http.post
    assert ask("/api/propose", json={"frame": 40, "point": [120, 65]}).json()["box"] == pytest.approx(
        (100, 50, 40, 30), abs=3
    )
    monkeypatch.setattr("psiamfcpp.serve.choose.find_box", lambda *_: None)
    assert ask("/api/propose", json={"frame": 40, "point": [400, 250]}).json() == {"box": None}


def test_the_address_lets_one_in_and_nobody_else(choosing: Choosing) -> None:
    http = choosing.http
    assert http.get("/").status_code == 200
    for path in ("/api/source", "/api/frame"):
        assert http.get(path).status_code == 401
    assert http.post("/api/choose", json={"frame": 0, "boxes": [BLOB]}).status_code == 401
    assert http.post("/api/enter", json={"token": choosing.token + "x"}).status_code == 401
    choosing.enter()
    answer = http.post("/api/enter", json={"token": choosing.token})
    assert (answer.status_code, "opened before" in answer.json()["error"]) == (401, True)
    assert http.get("/api/source").status_code == 200
    # another site's page may not ask, whatever it knows
    assert http.get("/api/source", headers={"Origin": "http://evil.example"}).status_code == 403


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({"frame": 0, "boxes": []}, "at least 1"),
        ({"frame": 0, "boxes": [[1, 1, 9, 9]] * 9}, "at most 8"),
        ({"frame": 0, "boxes": [[900, 1, 9, 9]]}, "lies outside the frame (480x320)"),
        ({"frame": 0, "boxes": [[1, 1, 0, 9]]}, "holds no pixel"),
        ({"frame": -1, "boxes": [[1, 1, 9, 9]]}, "greater than or equal to 0"),
    ],
)
def test_wrong_choices_are_refused_and_end_nothing(choosing: Choosing, body: Any, message: str) -> None:
    choosing.enter()
    answer = choosing.http.post("/api/choose", json=body)
    assert answer.status_code == 422
    assert message in answer.json()["error"]
    assert choosing.thread.is_alive()


def test_a_live_source_begins_with_the_frame_that_was_drawn_on(stream: Stream) -> None:
    source = stream.open(print)
    running = Choosing(source)
    running.enter()
    assert running.http.get("/api/source").json()["live"] is True
    first, image, _ = running.frame(after=0)
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert running.http.post("/api/hold", json={"frame": first}).json() == {"ok": True}
    stream.blobs = [(300.0, 200.0, 40.0, 30.0)]
    until(lambda: running.frame(after=first)[0] > first + 3)
    assert running.http.post("/api/choose", json={"frame": first, "boxes": [BLOB]}).status_code == 200
    running.thread.join(60)
    chosen = running.result
    assert chosen is not None
    assert chosen.start_frame == first
    shown = next(chosen.frames)
    assert shown[95, 120, 0] > 200 and shown[215, 320, 0] < 100
    until(lambda: next(chosen.frames)[215, 320, 0] > 200)
    source.close()


def test_a_frame_of_a_live_source_that_is_gone_is_refused(stream: Stream, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.ring.Ring.since", lambda *_: [])
    running = Choosing(stream.open(print))
    running.enter()
    number, _, _ = running.frame(after=0)
    answer = running.http.post("/api/choose", json={"frame": number, "boxes": [BLOB]})
    assert (answer.status_code, "no longer kept" in answer.json()["error"]) == (422, True)
    monkeypatch.undo()
    running.end()


def test_a_live_source_that_breaks_off_is_said(stream: Stream, monkeypatch: pytest.MonkeyPatch) -> None:
    running = Choosing(stream.open(print))
    running.enter()
    running.frame(after=0)
    get_after = _Live.get_after

    # The server ends as soon as the source breaks: it must not break before the request has arrived.
    def breaking(self: _Live, number: int) -> tuple[int, Any]:
        stream.broken = True
        return get_after(self, number)

    monkeypatch.setattr(_Live, "get_after", breaking)
    monkeypatch.setattr("psiamfcpp.serve.choose._NEW_FRAME_S", TIMEOUT_S)
    answer = running.http.get("/api/frame", params={"after": 10**9})
    assert answer.status_code == 422
    assert answer.json()["error"] == "stream test broke off"
    running.thread.join(60)
    assert isinstance(running.error, UserError)
    running.http.close()
