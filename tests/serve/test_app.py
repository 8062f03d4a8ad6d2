"""The API over real sockets: what it does, whom it obeys, and what it refuses, in one line each."""

from __future__ import annotations

import json
import math
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from psiamfcpp.geometry import centre_error
from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import Follower
from psiamfcpp.serve.live import MAX_CLIENTS

from .conftest import BLOB, HEIGHT, WIDTH, Stream, served, until

TOKEN = "correct horse battery"


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


# what it does


def test_a_target_is_started_followed_and_stopped_by_rest(http: httpx.Client, stream: Stream) -> None:
    answer = http.post("/api/targets", json={"box": BLOB})
    assert (answer.status_code, answer.json()) == (201, {"id": 1, "box": list(BLOB)})
    stream.blobs = [(112, 85, 40, 30)]

    def followed() -> Any:
        told = http.get("/api/state").json()
        return told if centre_error(told["targets"][0]["box"], stream.blobs[0]) < 1 else None

    told = until(followed)
    assert (told["width"], told["height"], told["selected"]) == (WIDTH, HEIGHT, 1)
    assert told["targets"][0]["state"] == "tracking"
    assert "bearing" not in told["targets"][0]
    assert http.delete("/api/targets/1").json() == {"ok": True}
    until(lambda: not http.get("/api/state").json()["targets"])
    texts = [event["text"] for event in http.get("/api/events").json()]
    assert texts == ["target 1 is followed", "target 1 was stopped"]
    assert [event["number"] for event in http.get("/api/events", params={"after": 1}).json()] == [2]


def test_a_point_becomes_a_box(http: httpx.Client) -> None:
    proposed = http.post("/api/propose", json={"point": [118, 94]}).json()["box"]
    assert proposed == pytest.approx(BLOB, abs=3)
    assert http.post("/api/targets", json={"point": [118, 94]}).json()["box"] == pytest.approx(BLOB, abs=3)


def test_several_targets_and_the_chosen_one(http: httpx.Client, stream: Stream) -> None:
    stream.blobs = [BLOB, (520, 380, 30, 40)]
    time.sleep(0.1)
    for box in stream.blobs:
        assert http.post("/api/targets", json={"box": box}).status_code == 201
    assert http.put("/api/selected", json={"id": 1}).json() == {"ok": True}
    told = until(lambda: (s := http.get("/api/state").json())["selected"] == 1 and s)
    assert [target["id"] for target in told["targets"]] == [1, 2]
    assert http.delete("/api/targets").json() == {"ok": True}
    until(lambda: not http.get("/api/state").json()["targets"])


def test_the_socket_tells_of_frames_and_obeys(address: str, stream: Stream) -> None:
    with live(address) as socket:
        first = state(socket)
        assert first["operator"] == "none"
        reply = ask(socket, type="start", box=BLOB)
        assert reply == {"type": "reply", "request": 7, "ok": True, "id": 1, "box": list(BLOB)}
        told = until(lambda: (s := state(socket))["targets"] and s)
        assert told["operator"] == "you"
        numbers = [state(socket)["frame"] for _ in range(5)]
        assert numbers == sorted(set(numbers))
        assert ask(socket, type="propose", point=[118, 94])["box"] == pytest.approx(BLOB, abs=3)
        assert ask(socket, type="select", id=1)["ok"]
        assert ask(socket, type="stop")["ok"]
        until(lambda: not state(socket)["targets"])
        assert ask(socket, type="operator", take=False)["ok"]
        until(lambda: state(socket)["operator"] == "none")


def test_latency_is_measured_and_told(address: str) -> None:
    with live(address) as socket:
        told = until(lambda: (s := state(socket))["latency_ms_median"] is not None and s)
        assert told["latency_ms"] > 0
        assert told["tracker_ms"] >= 0


def test_pictures_come_when_asked_for_with_the_state_of_their_frame(address: str, stream: Stream) -> None:
    with live(address) as socket:
        assert not state(socket)["jpeg"]
        socket.send(json.dumps({"type": "frame"}))
        pictures, states, text = [], [], {}
        end = time.monotonic() + 1
        while time.monotonic() < end or not pictures:
            message = socket.recv(timeout=30)
            if isinstance(message, bytes):
                assert text["jpeg"]
                pictures.append(message)
            else:
                text = json.loads(message)
                states.append(text)
        # one was asked for, so one came, however many frames did
        assert (len(pictures), sum(told["jpeg"] for told in states)) == (1, 1)
        image = cv2.imdecode(np.frombuffer(pictures[0], np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert image[95, 120].mean() > 200


def test_pictures_for_other_programs(http: httpx.Client) -> None:
    http.post("/api/targets", json={"box": BLOB})
    plain = http.get("/api/frame.jpg")
    assert plain.headers["content-type"] == "image/jpeg"
    assert cv2.imdecode(np.frombuffer(plain.content, np.uint8), cv2.IMREAD_COLOR).shape == (HEIGHT, WIDTH, 3)
    with http.stream("GET", "/api/stream.mjpg") as answer:
        data = b""
        for part in answer.iter_raw():
            data += part
            if data.count(b"--frame") > 3:
                break
    jpeg = data.split(b"\r\n\r\n", 1)[1].split(b"\r\n--frame")[0]
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    # the outline of the box, in green
    assert image[80, 110, 1] > image[80, 110, 2] + 60


def test_a_silent_stream_is_told_and_so_is_its_return(
    address: str, stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psiamfcpp.serve.status._SILENT_S", 0.2)
    with live(address) as socket:
        assert state(socket)["source"]["state"] == "playing"
        stream.silent = True
        until(lambda: state(socket)["source"]["state"] == "silent")
        stream.silent = False
        until(lambda: state(socket)["source"]["state"] == "playing")


def test_bearings_are_told_where_the_field_of_view_is_known(control: Control) -> None:
    with served(control, fov=60.0) as address, httpx.Client(base_url=f"http://{address}") as http:
        http.post("/api/targets", json={"box": BLOB})
        (target,) = until(lambda: http.get("/api/state").json()["targets"])
        assert target["bearing"]["azimuth_deg"] < -15
        assert target["bearing"]["elevation_deg"] > 10


def test_the_description_names_every_way_in(http: httpx.Client) -> None:
    paths = http.get("/openapi.json").json()["paths"]
    assert paths.keys() == {
        "/api/login",
        "/api/targets",
        "/api/targets/{number}",
        "/api/selected",
        "/api/propose",
        "/api/operator",
        "/api/recording",
        "/api/state",
        "/api/events",
        "/api/frame.jpg",
        "/api/stream.mjpg",
    }


def test_the_page_loads_nothing_from_elsewhere(http: httpx.Client) -> None:
    page = http.get("/")
    assert "default-src 'self'" in page.headers["content-security-policy"]
    for path in ("/", "/page.js", "/page.css"):
        text = http.get(path).text
        assert len(text) > 500
        assert "http://" not in text.replace("http://www.w3.org", "")
        assert "https://" not in text
    # a generated page of documentation would load its own from elsewhere
    assert http.get("/docs").status_code == 404


# whom it obeys


def test_one_operates_and_others_watch(address: str, http: httpx.Client, follower: Follower) -> None:
    with live(address) as first, live(address) as second:
        assert ask(first, type="start", box=BLOB)["ok"]
        refused = ask(second, type="stop")
        assert refused == {
            "type": "reply",
            "request": 7,
            "ok": False,
            "error": "another client is in control: wait until it hands over or leaves",
        }
        until(lambda: state(second)["operator"] == "other" and state(second)["targets"])
        assert http.delete("/api/targets").status_code == 409
        assert ask(first, type="operator", take=False)["ok"]
        assert ask(second, type="stop")["ok"]
    assert http.post("/api/operator", headers={"X-Client": "me"}).status_code == 409


def test_an_operator_that_comes_back_is_still_one(address: str) -> None:
    with connect(f"ws://{address}/api/live?client=pilot") as socket:
        assert ask(socket, type="operator", take=True)["ok"]
    with connect(f"ws://{address}/api/live?client=pilot") as socket:
        assert state(socket)["operator"] == "you"


def test_control_is_free_once_its_holder_is_silent(control: Control, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.control.LEASE_S", 0.05)
    control.take("a")
    time.sleep(0.1)
    control.take("b")
    assert control.lease.holder == "b"


@pytest.mark.parametrize("given", [None, "wrong", TOKEN[:-1], TOKEN + "x", "ü" * 20])
def test_a_wrong_token_opens_nothing(control: Control, given: str | None) -> None:
    headers = {} if given is None else {"Authorization": f"Bearer {given}".encode()}
    with served(control, token=TOKEN) as address:
        with httpx.Client(base_url=f"http://{address}", headers=headers) as http:
            for method, path in (("GET", "/api/state"), ("POST", "/api/targets"), ("GET", "/openapi.json")):
                answer = http.request(method, path)
                assert (answer.status_code, list(answer.json())) == (401, ["error"])
            assert http.post("/api/login", json={"token": given or ""}).status_code == 401
            assert http.get("/").status_code == 200
        with pytest.raises(InvalidStatus) as refusal:
            live(address, additional_headers={} if given is None else {"Cookie": "psiamfcpp_token=wrong"})
        assert refusal.value.response.status_code == 401


def test_the_token_opens_everything(control: Control) -> None:
    with served(control, token=TOKEN) as address:
        with httpx.Client(base_url=f"http://{address}") as http:
            known = {"Authorization": f"Bearer {TOKEN}"}
            assert http.get("/api/state", headers=known).status_code == 200
            described = http.get("/openapi.json", headers=known).json()
            (name,) = described["security"][0]
            assert described["components"]["securitySchemes"][name] == {"type": "http", "scheme": "bearer"}
            login = http.post("/api/login", json={"token": TOKEN})
            cookie = login.headers["set-cookie"]
            assert "HttpOnly" in cookie
            assert "samesite=strict" in cookie.lower()
            assert http.get("/api/state").status_code == 200
            # with a token, any name may lead here
            assert http.get("/api/state", headers={"Host": "drone.local"}).status_code == 200
        with live(address, additional_headers={"Cookie": cookie.split(";")[0]}) as socket:
            assert state(socket)["frame"] > 0
        with live(address, additional_headers={"Authorization": f"Bearer {TOKEN}"}) as socket:
            assert ask(socket, type="start", box=BLOB)["ok"]


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:1", "http://["])
def test_foreign_origins_are_refused(address: str, http: httpx.Client, origin: str, follower: Follower) -> None:
    answer = http.post("/api/targets", json={"box": BLOB}, headers={"Origin": origin})
    assert (answer.status_code, answer.json()) == (403, {"error": "requests from other sites' pages are refused"})
    with pytest.raises(InvalidStatus) as refusal:
        live(address, origin=origin)
    assert refusal.value.response.status_code == 403
    assert follower.newest is not None
    assert not follower.newest.tracks


@pytest.mark.parametrize(
    "headers", [{"Origin": "http://evil.example"}, {"Sec-Fetch-Site": "cross-site"}, {"Sec-Fetch-Site": "same-site"}]
)
def test_other_sites_pages_cannot_even_watch(http: httpx.Client, headers: dict[str, str]) -> None:
    for path in ("/api/state", "/api/frame.jpg", "/api/stream.mjpg", "/page.js"):
        assert http.get(path, headers=headers).status_code == 403
    assert http.get("/api/state", headers={"Sec-Fetch-Site": "same-origin"}).status_code == 200
    # a link to the page is no harm
    assert http.get("/", headers={"Sec-Fetch-Site": "cross-site"}).status_code == 200


def test_the_own_origin_is_welcome(address: str) -> None:
    with live(address, origin=f"http://{address}") as socket:
        assert state(socket)["frame"] > 0


def test_foreign_names_for_this_machine_are_refused(http: httpx.Client) -> None:
    answer = http.get("/api/state", headers={"Host": "evil.example"})
    assert (answer.status_code, answer.json()) == (
        403,
        {"error": "this server answers to this machine's own names only"},
    )


# what it refuses


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


def test_oversized_bodies_are_refused(http: httpx.Client, follower: Follower) -> None:
    http.post("/api/targets", json={"box": BLOB})
    large = b" " * 200_000
    answer = http.post("/api/targets", content=large)
    assert (answer.status_code, answer.json()) == (413, {"error": "a request may hold 16384 bytes"})
    # and where the size is not said
    assert http.post("/api/targets", content=iter([large[:9000]] * 20)).status_code in (400, 413)
    unharmed(follower)


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
            while (reply := json.loads(socket.recv(timeout=30)))["type"] != "reply":
                pass
            assert (reply["ok"], reply["request"]) == (False, number)


def test_a_client_that_only_makes_mistakes_is_sent_away(address: str, follower: Follower) -> None:
    follower.add(BLOB)
    with live(address) as socket, pytest.raises(ConnectionClosed) as end:
        for _ in range(1000):
            socket.send("nonsense")
        while True:
            socket.recv(timeout=30)
    assert end.value.rcvd is not None
    assert end.value.rcvd.code == 1008
    unharmed(follower)


def test_an_oversized_message_ends_its_connection_alone(address: str, follower: Follower) -> None:
    follower.add(BLOB)
    with live(address) as other:
        with live(address) as socket, pytest.raises(ConnectionClosed) as end:
            socket.send("x" * 100_000)
            while True:
                socket.recv(timeout=30)
        assert end.value.rcvd is not None
        assert end.value.rcvd.code == 1009
        assert state(other)["frame"] > 0
    unharmed(follower)


def test_a_thousand_starts_are_mostly_refused(address: str, follower: Follower) -> None:
    follower.add(BLOB)
    with live(address) as socket:
        codes: list[bool] = []
        for number in range(1000):
            socket.send(json.dumps({"type": "start", "box": [10, 10, 0.5, 0.5], "request": number}))
        try:
            while len(codes) < 1000:
                data = json.loads(socket.recv(timeout=30))
                if data["type"] == "reply":
                    codes.append(data["ok"])
                    assert "too many" in data["error"] or "holds no pixel" in data["error"]
        except ConnectionClosed as end:
            assert end.rcvd is not None and end.rcvd.code == 1008
        assert not any(codes)
    unharmed(follower)


def test_starts_over_rest_are_limited_too(http: httpx.Client) -> None:
    codes = [http.put("/api/selected", json={"id": 3}).status_code for _ in range(60)]
    assert set(codes) == {422, 429}
    assert codes.count(429) > 20


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


# how it lasts


def test_those_who_connect_and_say_nothing_keep_nobody_out(control: Control, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.server._SILENT_S", 1)
    with served(control) as address:
        host, port = address.split(":")
        begun = b"GET /api/state HTTP/1.1\r\nHost: 127.0.0.1\r\n"
        sockets = [socket.create_connection((host, int(port))) for _ in range(70)]
        with httpx.Client(base_url=f"http://{address}", timeout=30) as http:
            http.get("/api/state")
            for number, silent in enumerate(sockets):
                silent.settimeout(30)
                # some begin a request, some have had one answered and begin the next
                silent.sendall([b"", begun, begun + b"\r\n" + begun][number % 3])
            for silent in sockets:
                while silent.recv(4096):
                    pass
                silent.close()
            assert http.get("/api/state").status_code == 200


def test_a_body_that_does_not_come_is_not_waited_for(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.guard._BODY_S", 0.2)
    host, port = address.split(":")
    with socket.create_connection((host, int(port)), timeout=30) as slow:
        slow.sendall(b"POST /api/targets HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 30\r\n\r\n{")
        assert slow.recv(4096).startswith(b"HTTP/1.1 4")


def test_a_client_that_reads_slowly_reads_what_is_new(address: str, stream: Stream, follower: Follower) -> None:
    stream.fps = 100
    with live(address, max_queue=1) as slow:
        for _ in range(40):
            time.sleep(0.05)
            told = state(slow)
            assert follower.newest is not None
            # five frames go by between two looks: were they kept for it, it would be 160 behind at the end
            assert told["frame"] > follower.newest.number - 100
        slow.close_timeout = 0.1


def test_clients_that_read_nothing_delay_nobody(address: str, stream: Stream) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    stream._draw = lambda *_, **__: noise.copy()  # large pictures
    slow = [live(address, max_queue=1) for _ in range(4)]
    try:
        for socket in slow:
            for _ in range(200):
                socket.send(json.dumps({"type": "frame"}))
        time.sleep(1)
        with live(address) as quick:
            first = state(quick)["frame"]
            start = time.monotonic()
            told = until(lambda: (s := state(quick))["frame"] >= first + 30 and s)
            # at 50 frames a second it is 0.6 s; clients that delayed it would do so for seconds each
            assert time.monotonic() - start < 15
            assert told["clients"] == 5
    finally:
        for socket in slow:
            socket.close_timeout = 0.1
            socket.close()


def test_connects_and_disconnects_leave_nothing(address: str, http: httpx.Client) -> None:
    def once(number: int) -> None:
        socket = live(address)
        socket.send(json.dumps({"type": "frame"}))
        socket.recv(timeout=30)
        if number % 2:
            socket.socket.shutdown(2)  # without a word
        else:
            socket.close()

    once(0)
    until(lambda: http.get("/api/state").json()["clients"] == 0)
    before = {thread.name for thread in threading.enumerate() if "recv_events" not in thread.name}
    for number in range(12):
        once(number)
    until(lambda: http.get("/api/state").json()["clients"] == 0)
    until(
        lambda: (
            {
                thread.name
                for thread in threading.enumerate()
                if thread.name not in before
                and "recv_events" not in thread.name
                and not thread.name.startswith("serve_")
            }
            == set()
        )
    )


def test_it_ends_while_clients_are_there(control: Control) -> None:
    with served(control) as address:
        socket = live(address)
        state(socket)
        stop = threading.Event()

        def watch() -> None:
            with httpx.stream("GET", f"http://{address}/api/stream.mjpg", timeout=30) as answer:
                try:
                    for _ in answer.iter_raw():
                        if stop.is_set():
                            return
                except httpx.HTTPError:
                    return

        watcher = threading.Thread(target=watch)
        watcher.start()
        until(lambda: state(socket)["clients"] == 2)
        start = time.monotonic()
    assert time.monotonic() - start < 20
    stop.set()
    watcher.join(30)
    assert not watcher.is_alive()
    with pytest.raises((ConnectionClosed, OSError)):
        while True:
            socket.recv(timeout=30)


def test_numbers_in_the_state_are_finite(http: httpx.Client) -> None:
    told = http.get("/api/state").json()
    numbers = [value for value in told.values() if isinstance(value, float)]
    assert all(math.isfinite(value) for value in numbers)
