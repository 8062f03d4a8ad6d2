"""How the server lasts: clients that are silent, slow, many, or still there at its end."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time

import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed

from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import Follower

from .conftest import HEIGHT, TIMEOUT_S, WIDTH, Stream, browse, live, served, state, until


@pytest.mark.slow
def test_those_who_connect_and_say_nothing_keep_nobody_out(control: Control, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.server._SILENT_S", 1)
    with served(control) as address:
        host, port = address.split(":")
        begun = b"GET /api/state HTTP/1.1\r\nHost: 127.0.0.1\r\n"
        sockets = [socket.create_connection((host, int(port))) for _ in range(70)]
        with browse(address) as http:
            http.get("/api/state")
            for number, silent in enumerate(sockets):
                silent.settimeout(TIMEOUT_S)
                # some begin a request, some have had one answered and begin the next
                with contextlib.suppress(ConnectionError):  # closed already, where the machine is slow
                    silent.sendall([b"", begun, begun + b"\r\n" + begun][number % 3])
            for silent in sockets:
                with contextlib.suppress(ConnectionError):
                    while silent.recv(4096):
                        pass
                silent.close()
            assert http.get("/api/state").status_code == 200


@pytest.mark.slow
def test_a_body_that_does_not_come_is_not_waited_for(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.guard._BODY_S", 0.2)
    host, port = address.split(":")
    with socket.create_connection((host, int(port)), timeout=TIMEOUT_S) as slow:
        slow.sendall(b"POST /api/targets HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 30\r\n\r\n{")
        assert slow.recv(4096).startswith(b"HTTP/1.1 4")


@pytest.mark.slow
def test_a_request_that_breaks_off_is_not_carried_out(address: str, http: httpx.Client) -> None:
    host, port = address.split(":")
    head = b"POST /api/operator HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Client: broken\r\nContent-Length: "
    with socket.create_connection((host, int(port))) as broken:
        broken.sendall(head + b"30\r\n\r\n{")
        assert http.get("/api/state").json()["operator"] == "none"
    time.sleep(0.2)
    assert http.get("/api/state").json()["operator"] == "none"
    with socket.create_connection((host, int(port)), timeout=TIMEOUT_S) as complete:
        complete.sendall(head + b"0\r\n\r\n")
        assert complete.recv(4096).startswith(b"HTTP/1.1 200")
    assert http.get("/api/state").json()["operator"] == "other"


@pytest.mark.slow
def test_a_client_that_reads_slowly_reads_what_is_new(address: str, stream: Stream, follower: Follower) -> None:
    stream.fps = 200
    with live(address, max_queue=1) as slow:
        first = state(slow)["frame"]
        reached = until(lambda: follower.newest and (n := follower.newest.number) >= first + 100 and n)
        # were they kept for it, it would have to read 100 old states first
        assert any(state(slow)["frame"] >= reached for _ in range(40))
        slow.close_timeout = 0.1


@pytest.mark.slow
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
            first = state(quick)
            assert first["clients"] == 5
            until(lambda: state(quick)["frame"] >= first["frame"] + 30)
    finally:
        for socket in slow:
            socket.close_timeout = 0.1
            socket.close()


def test_connects_and_disconnects_leave_nothing(address: str, http: httpx.Client) -> None:
    def once(number: int) -> None:
        socket = live(address)
        socket.send(json.dumps({"type": "frame"}))
        socket.recv(timeout=TIMEOUT_S)
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


@pytest.mark.slow
def test_it_ends_while_clients_are_there(control: Control) -> None:
    with served(control) as address:
        socket = live(address)
        state(socket)
        stop = threading.Event()

        def watch() -> None:
            with httpx.stream("GET", f"http://{address}/api/stream.mjpg", timeout=TIMEOUT_S) as answer:
                try:
                    for _ in answer.iter_raw():
                        if stop.is_set():
                            return
                except httpx.HTTPError:
                    return

        watcher = threading.Thread(target=watch)
        watcher.start()
        until(lambda: state(socket)["clients"] == 2)
    # `served` waits for the server's end
    stop.set()
    watcher.join(TIMEOUT_S)
    assert not watcher.is_alive()
    with pytest.raises((ConnectionClosed, OSError)):
        while True:
            socket.recv(timeout=TIMEOUT_S)
