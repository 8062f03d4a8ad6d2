"""A stream that tests command, followers of it on an engine that sees a blob, and servers on loopback."""

from __future__ import annotations

import contextlib
import json
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import quote

import httpx
import numpy as np
import pytest
from websockets.sync.client import ClientConnection, connect

from psiamfcpp import TargetPool
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image, centre_error
from psiamfcpp.serve.app import build_app
from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import Follower
from psiamfcpp.serve.server import bind, make_server, run
from psiamfcpp.video.source import Source

WIDTH, HEIGHT = 640, 480
BLOB: Box = (100.0, 80.0, 40.0, 30.0)
TOKEN = "correct horse battery"


# No verdict depends on it unless something never comes.
TIMEOUT_S = 120.0


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits of the server that a slow machine could reach where a test is not about them."""
    monkeypatch.setattr("psiamfcpp.serve.control.LEASE_S", 3600.0)
    monkeypatch.setattr("psiamfcpp.serve.follower._ANSWER_S", TIMEOUT_S)
    monkeypatch.setattr("psiamfcpp.serve.live._SEND_S", TIMEOUT_S)


def until(condition: Callable[[], Any], seconds: float = TIMEOUT_S) -> Any:
    """Wait until something holds; what it gave."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "it never came to hold"
        time.sleep(0.01)
    return found


class Clock:
    """Seconds that pass when a test says so."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Stream:
    """A camera of blobs: their boxes can be moved, and it can fall silent, break and end."""

    def __init__(self, draw: Callable[..., Image]):
        self._draw = draw
        self.blobs: list[Box] = [BLOB]
        self.live = True
        self.silent = False
        self.broken = False
        self.fps = 50.0
        self.length: int | None = None
        self.opened = 0
        self.closed = threading.Event()

    def open(self, tell: Callable[[str], None]) -> Source:
        """As `open_source` does."""
        if self.broken:
            raise UserError("stream test cannot be opened")
        self.opened += 1
        return Source("test", self.fps, None, self.live, self._frames(), self.closed.set)

    def _frames(self) -> Iterator[Image]:
        count = 0
        while not self.closed.is_set() or not self.live:
            if self.broken:
                raise UserError("stream test broke off")
            if self.live:
                time.sleep(1 / self.fps)
            if self.silent:
                continue
            yield np.maximum.reduce([self._draw(box, width=WIDTH, height=HEIGHT) for box in self.blobs])
            count += 1
            if count == self.length:
                return


@pytest.fixture
def stream(blob_frame: Callable[..., Image]) -> Stream:
    """A stream that shows one blob."""
    return Stream(blob_frame)


@pytest.fixture
def follower(stream: Stream, blob_engine: Any) -> Iterator[Follower]:
    """Follows the stream; its first frame has come."""
    with Follower(stream.open, TargetPool()) as running:
        until(lambda: running.newest)
        yield running


@pytest.fixture
def control(follower: Follower) -> Control:
    """Commands the follower."""
    return Control(follower)


@contextlib.contextmanager
def served(control: Control, port: int = 0, **options: Any) -> Iterator[str]:
    """A server in a thread; its address as ``127.0.0.1:PORT``."""
    listener = bind("127.0.0.1", port)
    port = listener.getsockname()[1]
    ready = threading.Event()
    server = make_server(build_app(control, **options), ready.set)
    thread = threading.Thread(target=run, args=(server, listener, control.follower))
    thread.start()
    assert ready.wait(TIMEOUT_S)
    try:
        yield f"127.0.0.1:{port}"
    finally:
        server.should_exit = True
        thread.join(TIMEOUT_S)
        assert not thread.is_alive()


@pytest.fixture
def address(control: Control) -> Iterator[str]:
    """A server without a token."""
    with served(control) as where:
        yield where


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    """A port that nobody uses now, and that the system gives to nobody who asks for any."""
    while True:
        with socket.socket(socket.AF_INET, kind) as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", random.SystemRandom().randrange(15_000, 30_000)))
            return int(probe.getsockname()[1])


def browse(address: str, **options: Any) -> httpx.Client:
    """A client that waits long, and drops an unused connection long before the server does."""
    limits = httpx.Limits(keepalive_expiry=1.0)
    # Without certificates, which nothing here needs and which take long to read.
    return httpx.Client(base_url=f"http://{address}", limits=limits, verify=False, **{"timeout": TIMEOUT_S, **options})


@pytest.fixture
def http(address: str) -> Iterator[httpx.Client]:
    with browse(address) as client:
        yield client


def live(address: str, client: str | None = None, **options: Any) -> ClientConnection:
    """A connection that is closed by a ``with`` block, or by hand."""
    query = "" if client is None else f"?client={quote(client)}"
    # no pings of its own: those that do not read would not see the answers
    patience = {"open_timeout": TIMEOUT_S, "ping_interval": None}
    return connect(f"ws://{address}/api/live{query}", max_size=None, **{**patience, **options}).__enter__()


def state(socket: ClientConnection) -> dict[str, Any]:
    """The next state that the server tells."""
    while True:
        message = socket.recv(timeout=TIMEOUT_S)
        if isinstance(message, str) and (data := json.loads(message))["type"] == "state":
            return dict(data)


def ask(socket: ClientConnection, **message: Any) -> dict[str, Any]:
    """The reply to a message."""
    socket.send(json.dumps({**message, "request": 7}))
    while True:
        answer = socket.recv(timeout=TIMEOUT_S)
        if isinstance(answer, str) and (data := json.loads(answer))["type"] == "reply":
            return dict(data)


def later(follower: Follower, frames: int = 3) -> None:
    """Wait for frames that the source gives after now."""
    before = follower.newest.number if follower.newest else 0
    until(lambda: follower.newest and follower.newest.number > before + frames)


def unharmed(follower: Follower) -> None:
    """The target is followed, in frames that came after now."""
    later(follower)
    assert follower.newest is not None
    assert follower.newest.tracks[1].state == "tracking"
    assert centre_error(follower.newest.tracks[1].box, BLOB) < 1
