"""A stream that tests command, followers of it on an engine that sees a blob, and servers on loopback."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

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


def until(condition: Callable[[], Any], seconds: float = 60.0) -> Any:
    """Wait until something holds; what it gave."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "it never came to hold"
        time.sleep(0.01)
    return found


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
    assert ready.wait(30)
    try:
        yield f"127.0.0.1:{port}"
    finally:
        server.should_exit = True
        thread.join(30)
        assert not thread.is_alive()


@pytest.fixture
def address(control: Control) -> Iterator[str]:
    """A server without a token."""
    with served(control) as where:
        yield where


def free_port() -> int:
    """A UDP port that nobody listens on now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def http(address: str) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"http://{address}", timeout=30) as client:
        yield client


def live(address: str, **options: Any) -> ClientConnection:
    """A connection that is closed by a ``with`` block, or by hand."""
    return connect(f"ws://{address}/api/live", max_size=None, **options).__enter__()


def state(socket: ClientConnection) -> dict[str, Any]:
    """The next state that the server tells."""
    while True:
        message = socket.recv(timeout=30)
        if isinstance(message, str) and (data := json.loads(message))["type"] == "state":
            return dict(data)


def ask(socket: ClientConnection, **message: Any) -> dict[str, Any]:
    """The reply to a message."""
    socket.send(json.dumps({**message, "request": 7}))
    while True:
        answer = socket.recv(timeout=30)
        if isinstance(answer, str) and (data := json.loads(answer))["type"] == "reply":
            return dict(data)


def unharmed(follower: Follower) -> None:
    """The target is followed, in frames that came after now."""
    assert follower.newest is not None
    before = follower.newest.number
    until(lambda: follower.newest and follower.newest.number > before + 2)
    assert follower.newest.tracks[1].state == "tracking"
    assert centre_error(follower.newest.tracks[1].box, BLOB) < 1
