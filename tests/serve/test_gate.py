"""The gate: connections that say nothing, or say it slowly, give way to those that may come in."""

from __future__ import annotations

import contextlib
import errno
import http.client as http_client
import os
import select
import socket
import struct
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from psiamfcpp.serve.control import Control
from psiamfcpp.serve.gate import Gate, Listener

from .conftest import TIMEOUT_S, TOKEN, Clock, browse, live, served, state, until

KNOWN = {"Authorization": f"Bearer {TOKEN}"}


class Connection:
    """Stands in for a socket, without a file."""

    def __init__(self) -> None:
        self.open = True

    def fileno(self) -> int:
        return 5 if self.open else -1

    def shutdown(self, _: int) -> None:
        self.open = False

    def recv(self, _: int) -> bytes:
        raise BlockingIOError

    def close(self) -> None:
        self.open = False


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def gate(clock: Clock) -> Gate:
    made = Gate(clock)
    made.most = 16
    return made


def enter(gate: Gate, address: str, port: int) -> Connection:
    connection: Any = Connection()
    assert gate.admit(connection, (address, port))
    return connection  # type: ignore[no-any-return]


def test_the_oldest_of_the_crowd_goes_first(gate: Gate, clock: Clock) -> None:
    operator = enter(gate, "10.0.0.9", 1)
    crowd = []
    for port in range(200):
        clock.now += 0.01
        crowd.append(enter(gate, "10.0.0.1", port))
        assert sum(one.open for one in crowd) <= 16
    assert operator.open
    assert [one.open for one in crowd] == sorted(one.open for one in crowd)
    assert crowd[-1].open
    # one that comes now has time to say what it wants, though it comes from the same address
    late = enter(gate, "10.0.0.1", 1000)
    for port in range(1001, 1010):
        enter(gate, "10.0.0.1", port)
    assert late.open


def test_who_has_proven_something_stays(gate: Gate) -> None:
    known = enter(gate, "10.0.0.1", 1)
    gate.prove(("10.0.0.1", 1))
    for port in range(2, 500):
        enter(gate, "10.0.0.1", port)
    assert known.open


def test_where_all_are_served_newcomers_are_turned_away(gate: Gate) -> None:
    with contextlib.ExitStack() as stack:
        served_ones = []
        for port in range(16):
            served_ones.append(enter(gate, "10.0.0.1", port))
            gate.prove(("10.0.0.1", port))
            stack.enter_context(gate.serving(("10.0.0.1", port)))
        late: Any = Connection()
        assert not gate.admit(late, ("10.0.0.2", 1))
        assert all(one.open for one in served_ones)
    # now nothing is asked for any more
    enter(gate, "10.0.0.2", 1)


def test_the_silent_are_swept_and_the_served_are_not(gate: Gate, clock: Clock) -> None:
    silent, busy, done = (enter(gate, "10.0.0.1", port) for port in range(3))
    with gate.serving(("10.0.0.1", 1)):
        clock.now = 8
        with gate.serving(("10.0.0.1", 2)):
            pass
        clock.now = 11
        gate.sweep(10)
        assert (silent.open, busy.open, done.open) == (False, True, True)
        clock.now = 19
        gate.sweep(10)
        assert (busy.open, done.open) == (True, False)
    clock.now = 30
    gate.sweep(10)
    assert not busy.open


def test_unknown_clients_are_borne(gate: Gate) -> None:
    with gate.serving(("10.0.0.1", 77)):
        gate.prove(("10.0.0.1", 77))


@pytest.fixture
def crowd() -> Iterator[list[socket.socket]]:
    sockets: list[socket.socket] = []
    yield sockets
    for one in sockets:
        one.close()


def gone(one: socket.socket) -> bool:
    one.settimeout(0.01)
    try:
        return not one.recv(4096)
    except TimeoutError:
        return False
    except OSError:
        return True


@pytest.mark.slow
@pytest.mark.parametrize(
    "begun", [b"", b"GET / HT", b"POST /api/login HTTP/1.1\r\nHost: x\r\nContent-Length: 90\r\n\r\n"]
)
def test_a_crowd_keeps_nobody_out(
    control: Control, crowd: list[socket.socket], monkeypatch: pytest.MonkeyPatch, begun: bytes
) -> None:
    monkeypatch.setattr("psiamfcpp.serve.gate._MOST", 24)
    with served(control, token=TOKEN) as address:
        host, port = address.split(":")
        with live(address, additional_headers=KNOWN) as watching:
            state(watching)
            with browse(address, headers=KNOWN) as http:
                for number in range(120):
                    crowd.append(socket.create_connection((host, int(port))))
                    crowd[-1].sendall(begun)
                    if number % 10 == 0:
                        assert http.get("/api/state").status_code == 200
                        # and a connection of its own for it
                        once = http_client.HTTPConnection(host, int(port), timeout=TIMEOUT_S)
                        once.request("GET", "/api/state", headers=KNOWN)
                        assert once.getresponse().status == 200
                        once.close()
            # those above the limit were closed long before they were silent for too long
            assert until(lambda: sum(gone(one) for one in crowd) >= 90)
            state(watching)


@pytest.mark.slow
def test_a_body_that_comes_byte_by_byte_has_as_long_as_any(
    control: Control, crowd: list[socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psiamfcpp.serve.guard._BODY_S", 0.5)
    with served(control, token=TOKEN) as address:
        host, port = address.split(":")
        slow = socket.create_connection((host, int(port)), timeout=TIMEOUT_S)
        crowd.append(slow)
        slow.sendall(b"POST /api/login HTTP/1.1\r\nHost: x\r\nContent-Length: 16000\r\n\r\n")
        done = threading.Event()

        def dribble() -> None:
            with contextlib.suppress(OSError):
                while not done.wait(0.05):
                    slow.sendall(b" ")

        thread = threading.Thread(target=dribble)
        thread.start()
        answer = b""
        with contextlib.suppress(ConnectionError):
            while data := slow.recv(4096):
                answer += data
        done.set()
        thread.join()
    assert answer.startswith(b"HTTP/1.1 408 ")
    assert b"the request did not come in time" in answer


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs limits on files")
def test_no_file_is_left_and_those_who_come_are_turned_away() -> None:
    resource = pytest.importorskip("resource")
    with Listener(socket.AF_INET, socket.SOCK_STREAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        listener.setblocking(False)
        late = socket.create_connection(listener.getsockname())
        before = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (late.fileno() + 1, before[1]))
        filled = []
        try:
            with pytest.raises(OSError) as full:
                while True:
                    filled.append(os.open(os.devnull, os.O_RDONLY))
            assert full.value.errno == errno.EMFILE
            for _ in range(3):
                with pytest.raises((ConnectionAbortedError, BlockingIOError)):
                    listener.accept()
        finally:
            for file in filled:
                os.close(file)
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
        late.settimeout(TIMEOUT_S)
        with contextlib.suppress(ConnectionError):
            assert late.recv(1) == b""
        late.close()
        # afterwards all is as before
        with socket.create_connection(listener.getsockname()) as next_one:
            next_one.sendall(b"GET / HTTP/1.1\r\n\r\n")
            accepted, _ = until(lambda: accepted_now(listener))
            accepted.close()


def accepted_now(listener: Listener) -> Any:
    try:
        return listener.accept()
    except (BlockingIOError, ConnectionAbortedError):
        return None


def listening(gate: Gate) -> Listener:
    """A listener behind the gate, which does not block."""
    listener = Listener(socket.AF_INET, socket.SOCK_STREAM)
    listener.gate = gate
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    listener.setblocking(False)
    return listener


@pytest.mark.skipif(not hasattr(select, "epoll"), reason="needs epoll")
def test_connections_wait_until_they_have_sent_a_head(gate: Gate) -> None:
    with listening(gate) as listener:
        where = listener.getsockname()
        silent = [socket.create_connection(where) for _ in range(40)]
        left, speaker = socket.create_connection(where), socket.create_connection(where)
        left.close()
        speaker.sendall(b"GET / HT")
        until(lambda: accepted_now(listener) is None and not select.select([listener], [], [], 0)[0])
        speaker.sendall(b"TP/1.1\r\n\r\n")
        accepted, address = until(lambda: accepted_now(listener))
        assert address == speaker.getsockname()
        assert accepted.recv(99) == b"GET / HTTP/1.1\r\n\r\n"
        # what is readable is what the loop must look at, and nothing else
        assert accepted_now(listener) is None
        assert select.select([listener], [], [], 0)[0] == []
        # the oldest silent ones made room
        assert until(lambda: sum(gone(one) for one in silent) >= 25)
        late = [one for one in silent if not gone(one)]
        late[-1].sendall(b"a" * 20_000)
        assert select.select([listener], [], [], TIMEOUT_S)[0] == [listener]
        second, _ = until(lambda: accepted_now(listener))
        for one in (accepted, second, speaker, *silent):
            one.close()


@pytest.mark.skipif(not hasattr(select, "epoll"), reason="needs epoll")
def test_who_comes_now_is_accepted_before_those_who_wait(gate: Gate) -> None:
    with Listener(socket.AF_INET, socket.SOCK_STREAM) as listener, contextlib.ExitStack() as stack:
        listener.gate = gate
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        listener.setblocking(False)

        def ask() -> Any:
            one = stack.enter_context(socket.create_connection(listener.getsockname()))
            one.sendall(b"GET / HTTP/1.1\r\n\r\n")
            return one.getsockname()

        waiting = [ask() for _ in range(3)]
        accepted, first = until(lambda: accepted_now(listener))
        accepted.close()
        assert first in waiting
        newest = ask()
        # those who wait keep the loop awake, and nobody is lost
        order = []
        for _ in range(3):
            assert select.select([listener], [], [], TIMEOUT_S)[0] == [listener]
            accepted, address = until(lambda: accepted_now(listener))
            accepted.close()
            order.append(address)
        assert order[0] == newest
        assert {first, *order} == {*waiting, newest}
        assert accepted_now(listener) is None
        assert select.select([listener], [], [], 0)[0] == []


@pytest.mark.skipif(not hasattr(select, "epoll"), reason="needs epoll")
def test_who_has_left_takes_no_place(gate: Gate) -> None:
    with listening(gate) as listener:
        here = socket.create_connection(listener.getsockname())
        for _ in range(40):
            with socket.create_connection(listener.getsockname()) as one:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closed by a reset
                one.sendall(b"GET / HTTP/1.1\r\n\r\n")
            accepted_now(listener)
        here.sendall(b"GET / HTTP/1.1\r\n\r\n")
        accepted, address = until(lambda: accepted_now(listener))
        assert address == here.getsockname()
        accepted.close()
        here.close()
