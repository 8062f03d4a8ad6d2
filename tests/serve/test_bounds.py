"""What a connection may send, however it is split up: the rest is neither parsed nor kept."""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Callable, Iterator

import httpx
import pytest
from websockets.exceptions import ConnectionClosed

from psiamfcpp.serve.follower import Follower
from psiamfcpp.serve.limits import Bucket

from .conftest import BLOB, TIMEOUT_S, live, state, unharmed

LOGIN = b"POST /api/login HTTP/1.1\r\nHost: 127.0.0.1\r\n"
CHUNKED = LOGIN + b"Transfer-Encoding: chunked\r\n\r\n"


@pytest.fixture
def raw(address: str) -> Iterator[Callable[[], socket.socket]]:
    """Connections to the server, by hand."""
    host, port = address.split(":")
    made: list[socket.socket] = []

    def connect() -> socket.socket:
        made.append(socket.create_connection((host, int(port)), timeout=TIMEOUT_S))
        return made[-1]

    yield connect
    for one in made:
        one.close()


def pour(one: socket.socket, data: bytes, most: int = 1_000_000_000) -> int:
    """Send the same again and again, until the server has closed; how many bytes that took."""
    sent = 0
    try:
        while sent < most:
            one.sendall(data)
            sent += len(data)
    except TimeoutError:
        raise
    except OSError:  # also where the thread that reads has noticed it first
        pass
    return sent


def answers(one: socket.socket) -> bytes:
    """What comes until the server closes."""
    found = b""
    with contextlib.suppress(ConnectionError):
        while data := one.recv(65536):
            found += data
    return found


@pytest.mark.parametrize(
    ("head", "again"),
    [
        (CHUNKED, b"1\r\n \r\n" * 1000),
        (CHUNKED + b"1;", b"x" * 10_000),
        (CHUNKED + b"0\r\n", b"X-Trailer: y\r\n" * 1000),
        (LOGIN + b"Content-Length: 999999999999\r\n\r\n", b" " * 100_000),
        (b"GET / HTTP/1.1\r\n", b"X-A: b\r\n" * 1000),
        (b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 1000),
    ],
    ids=[
        "small chunks",
        "a long chunk's head",
        "trailers",
        "a long body",
        "headers",
        "requests whose answers are not read",
    ],
)
def test_who_sends_without_end_is_cut_off(
    raw: Callable[[], socket.socket], http: httpx.Client, follower: Follower, head: bytes, again: bytes
) -> None:
    follower.add(BLOB)
    endless = raw()
    endless.sendall(head)
    assert pour(endless, again) < 100_000_000
    assert http.get("/api/state").status_code == 200
    unharmed(follower)


def test_some_chunks_and_some_requests_at_once_are_fine(raw: Callable[[], socket.socket], follower: Follower) -> None:
    body = json.dumps({"box": BLOB}).encode()
    chunks = b"".join(b"%x\r\n%s\r\n" % (len(part), part) for part in (body[:5], body[5:9], body[9:])) + b"0\r\n\r\n"
    head = b"POST /api/targets HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
    get = b"GET /api/state HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    one = raw()
    one.sendall(
        head + b"Transfer-Encoding: chunked\r\n\r\n" + chunks + 49 * get + get[:-2] + b"Connection: close\r\n\r\n"
    )
    found = answers(one)
    assert found.count(b"HTTP/1.1 201 ") == 1
    assert found.count(b"HTTP/1.1 200 ") == 50
    unharmed(follower)


def test_a_body_that_is_too_long_is_answered(raw: Callable[[], socket.socket]) -> None:
    one = raw()
    one.sendall(LOGIN + b"Content-Length: 300000\r\n\r\n" + b" " * 300_000)
    found = answers(one)
    assert found.startswith(b"HTTP/1.1 413 ")
    assert found.count(b"HTTP/1.1 ") == 1


def test_who_will_say_no_more_is_answered(raw: Callable[[], socket.socket]) -> None:
    one = raw()
    one.sendall(b"GET /page.js HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    one.shutdown(socket.SHUT_WR)
    found = answers(one)
    assert found.startswith(b"HTTP/1.1 200 ")
    assert len(found) > 5000
    # but of what did not come whole nothing is expected any more
    other = raw()
    other.sendall(LOGIN + b"Content-Length: 30\r\n\r\n{")
    other.shutdown(socket.SHUT_WR)
    assert answers(other) == b""


def test_nonsense_after_an_answer_is_not_logged(
    raw: Callable[[], socket.socket], capfd: pytest.CaptureFixture[str], http: httpx.Client
) -> None:
    one = raw()
    one.sendall(CHUNKED + b"8000\r\n" + b" " * 0x8000)
    assert one.recv(4096).startswith(b"HTTP/1.1 413 ")
    one.sendall(b"\r\nnonsense\r\n\r\n")
    answers(one)
    assert http.get("/api/state").status_code == 200
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
@pytest.mark.parametrize(
    "frames",
    [
        b"\x01\x80\0\0\0\0" + b"\x00\x80\0\0\0\0" * 1000,
        b"\x89\x80\0\0\0\0" * 1000,
        b"\x8a\x80\0\0\0\0" * 1000,
        b"\x81\x91\0\0\0\0" + b'{"type": "frame"}',
    ],
    ids=["parts of nothing", "pings", "pongs", "messages"],
)
def test_a_client_that_floods_its_socket_is_sent_away(
    address: str, follower: Follower, monkeypatch: pytest.MonkeyPatch, frames: bytes
) -> None:
    # for the server no time passes, so that what it allows does not depend on how fast the frames come
    monkeypatch.setattr("psiamfcpp.serve.pace.Bucket", lambda *limits: Bucket(*limits, clock=lambda: 0.0))
    follower.add(BLOB)
    with live(address) as other:
        with live(address) as flooding:
            assert pour(flooding.socket, frames) < 100_000_000
            with pytest.raises(ConnectionClosed):
                while True:
                    flooding.recv(timeout=TIMEOUT_S)
        assert state(other)["frame"] > 0
    unharmed(follower)
