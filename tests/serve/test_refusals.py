"""What the API refuses, in one line each, while the target is followed on."""

from __future__ import annotations

import json
from socket import create_connection

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from psiamfcpp.serve.control import _COMMANDS_AT_ONCE, _COMMANDS_PER_S, Control
from psiamfcpp.serve.follower import Follower
from psiamfcpp.serve.limits import Bucket
from psiamfcpp.serve.live import _MOST_MISTAKES, MAX_CLIENTS

from .conftest import BLOB, TIMEOUT_S, ask, live, state, unharmed, until


@pytest.mark.parametrize(
    "body",
    [
        b'{"box": [NaN, 1, 2, 3]}',
        b'{"box": [1, 1, Infinity, 3]}',
        b'{"box": [1, 2, 3]}',
        b'{"box": "1,2,3,4"}',
        b'{"box": [9000, 1, 20, 20]}',
        b'{"box": [1e99, 1, 20, 20]}',
        b'{"box": [10, 10, 0, 20]}',
        b'{"box": [10, 10, 20, 20], "point": [1, 1]}',
        b'{"box": [10, 10, 20, 20], "speed": 3}',
        b'{"point": [-5, 10]}',
        b'{"point": [NaN, 10]}',
        b"{}",
        b"[]",
        b"null",
        b"{",
        b"\xff\xfe",
        b"[" * 10000,
    ],
)
def test_wrong_bodies_are_refused_in_one_line(http: httpx.Client, follower: Follower, body: bytes) -> None:
    assert http.post("/api/targets", json={"box": BLOB}).status_code == 201
    answer = http.post("/api/targets", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code in (400, 422)
    error = answer.json()["error"]
    assert error
    assert "\n" not in error
    assert len(error) < 300
    unharmed(follower)
    assert follower.newest is not None
    assert list(follower.newest.tracks) == [1]


@pytest.mark.parametrize("path", ["/api/targets/0", "/api/targets/x", "/api/targets/99", "/api/targets/1e3"])
def test_targets_that_are_none_cannot_be_stopped(http: httpx.Client, path: str) -> None:
    answer = http.delete(path)
    assert (answer.status_code, list(answer.json())) == (422, ["error"])


@pytest.mark.slow
def test_oversized_bodies_are_refused(http: httpx.Client, follower: Follower) -> None:
    http.post("/api/targets", json={"box": BLOB})
    large = b" " * 200_000
    answer = http.post("/api/targets", content=large)
    assert (answer.status_code, answer.json()) == (413, {"error": "a request may hold 16384 bytes"})
    # the rest of the body is not read, so clients must not use the connection again
    assert answer.headers["connection"] == "close"
    # and where the size is not said
    assert http.post("/api/targets", content=iter([large[:9000]] * 20)).status_code in (400, 413)
    unharmed(follower)


@pytest.mark.slow
@pytest.mark.parametrize(
    "message",
    [
        "",
        "null",
        "{",
        "[]",
        '{"type": "fly"}',
        '{"type": "start", "box": [NaN, 1, 2, 3]}',
        '{"type": "start", "box": [1, 2, 3]}',
        '{"type": "start"}',
        '{"type": "start", "box": [9000, 1, 20, 20]}',
        '{"type": "stop", "id": 1e40}',
        '{"type": "stop", "id": 77}',
        '{"type": "record", "on": true}',
        b"\x00\xff binary",
        "\x00",
    ],
)
def test_wrong_messages_are_refused_in_one_line(address: str, follower: Follower, message: str | bytes) -> None:
    with live(address) as socket:
        assert ask(socket, type="start", box=BLOB)["ok"]
        socket.send(message)
        reply = ask(socket, type="select", id=1)
        # the refusal came first
        assert not reply["ok"]
        assert "\n" not in reply["error"]
        unharmed(follower)


def test_a_refusal_names_its_request(address: str) -> None:
    with live(address) as socket:
        for message, number in (
            ('{"type": "start", "box": [NaN, 1, 2, 3], "request": 41}', 41),
            ('{"type": "fly", "request": 42}', 42),
            ('{"type": "fly", "request": "43"}', None),
            ("[" * 4000, None),
            ('{"type": "start", "box": [9000, 1, 20, 20], "request": 44}', 44),
        ):
            socket.send(message)
            while (reply := json.loads(socket.recv(timeout=TIMEOUT_S)))["type"] != "reply":
                pass
            assert (reply["ok"], reply["request"]) == (False, number)


def test_a_client_that_only_makes_mistakes_is_sent_away(address: str, follower: Follower) -> None:
    follower.add(BLOB)
    with live(address) as socket, pytest.raises(ConnectionClosed) as end:
        for _ in range(_MOST_MISTAKES + 1):
            socket.send("nonsense")
        while True:
            socket.recv(timeout=TIMEOUT_S)
    assert end.value.rcvd is not None
    assert end.value.rcvd.code == 1008
    unharmed(follower)


@pytest.mark.slow
def test_what_clients_do_wrong_is_not_logged(
    capfd: pytest.CaptureFixture[str], address: str, follower: Follower, http: httpx.Client
) -> None:
    host, port = address.split(":")
    follower.add(BLOB)
    # a text frame that is not UTF-8; frames that break the rules; a handshake that is none
    for frame, opcode, code in ((b"\xff\xfe", 0x81, 1007), (b"ab", 0x83, 1002), (b"ab", 0xF1, 1002)):
        socket = live(address)
        # masked with zeros, which changes nothing
        socket.socket.sendall(bytes([opcode, 0x80 | len(frame), 0, 0, 0, 0]) + frame)
        with pytest.raises(ConnectionClosed) as end:
            while True:
                socket.recv(timeout=TIMEOUT_S)
        assert end.value.rcvd is None or end.value.rcvd.code == code
        socket.close()
    for request in (
        b"\x00\xff\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET /api/live HTTP/1.1\r\nUpgrade: websocket\r\n\r\n",
    ):
        with create_connection((host, int(port)), timeout=TIMEOUT_S) as raw:
            raw.sendall(request)
            raw.recv(4096)
    with pytest.raises(InvalidStatus):
        live(address, origin="http://elsewhere.example")
    assert http.get("/api/state").status_code == 200
    unharmed(follower)
    out, err = capfd.readouterr()
    assert (out, err) == ("", "")


@pytest.mark.parametrize("size", [5_000, 100_000])
def test_an_oversized_message_ends_its_connection_alone(address: str, follower: Follower, size: int) -> None:
    follower.add(BLOB)
    with live(address) as other:
        with live(address) as socket, pytest.raises(ConnectionClosed) as end:
            socket.send("x" * size)
            while True:
                socket.recv(timeout=TIMEOUT_S)
        # a client that is cut off while it still sends may not come to read the reason
        assert (end.value.rcvd and end.value.rcvd.code) in ((1009,) if size < 10_000 else (1009, None))
        assert state(other)["frame"] > 0
    unharmed(follower)


@pytest.fixture
def timeless(control: Control) -> None:
    """Commands as if they came all at once."""
    control._bucket = Bucket(_COMMANDS_PER_S, _COMMANDS_AT_ONCE, lambda: 0.0)


@pytest.mark.slow
def test_starts_are_limited(address: str, follower: Follower, timeless: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.live._MESSAGES_AT_ONCE", 1e6)
    follower.add(BLOB)
    errors: list[str] = []
    with live(address) as socket:
        for number in range(200):
            socket.send(json.dumps({"type": "start", "box": [10, 10, 0.5, 0.5], "request": number}))
        while len(errors) < 200:
            data = json.loads(socket.recv(timeout=TIMEOUT_S))
            if data["type"] == "reply":
                assert not data["ok"]
                errors.append(data["error"])
    assert all("holds no pixel" in error for error in errors[:10])
    assert all("too many" in error for error in errors[10:])
    unharmed(follower)


@pytest.mark.slow
def test_who_sends_too_much_is_sent_away(address: str, follower: Follower, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.live.Bucket", lambda *_: Bucket(0.0, 0.0))
    follower.add(BLOB)
    with live(address) as socket, pytest.raises(ConnectionClosed) as end:
        for _ in range(_MOST_MISTAKES + 1):
            socket.send(json.dumps({"type": "frame"}))
        while True:
            socket.recv(timeout=TIMEOUT_S)
    assert end.value.rcvd is not None
    assert (end.value.rcvd.code, end.value.rcvd.reason) == (1008, "too many mistakes")
    unharmed(follower)


def test_starts_over_rest_are_limited_too(http: httpx.Client, timeless: None) -> None:
    codes = [http.put("/api/selected", json={"id": 3}).status_code for _ in range(30)]
    assert codes == [422] * 10 + [429] * 20


@pytest.mark.slow
def test_there_is_room_for_some_clients_only(address: str, http: httpx.Client) -> None:
    sockets = [live(address) for _ in range(MAX_CLIENTS)]
    try:
        with pytest.raises(InvalidStatus) as refusal:
            live(address)
        assert refusal.value.response.status_code == 503
        assert http.get("/api/stream.mjpg").status_code == 503
    finally:
        for socket in sockets:
            socket.close()
    until(lambda: http.get("/api/state").json()["clients"] == 0)
    with live(address) as socket:
        assert state(socket)["clients"] == 1
