"""Load a server in ways that must keep no operator out, and time an operator meanwhile; used by `serve_soak.py`.

    python benchmarks/serve_loads.py silent_burst 127.0.0.1 8000 14580 10

runs one load alone, in a process of its own, which leaves the measuring process undisturbed. Loopback addresses only.
"""

from __future__ import annotations

import contextlib
import http.client
import ipaddress
import itertools
import json
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mav
from websockets.sync.client import connect

_MOST_SOCKETS = 1500


def silent_burst(host: str, port: int, _: int, seconds: float) -> None:
    """Open 1,500 silent connections at once, and replace those that are closed."""
    _hold(host, port, seconds, _MOST_SOCKETS, 0.0, b"")


def silent_rate(host: str, port: int, _: int, seconds: float) -> None:
    """Open 100 silent connections a second."""
    _hold(host, port, seconds, _MOST_SOCKETS, 0.01, b"")


def slow_bodies(host: str, port: int, _: int, seconds: float) -> None:
    """Send 75 logins whose bodies come at a byte every 5 s."""
    head = b"POST /api/login HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 16000\r\n\r\n"
    _hold(host, port, seconds, 75, 0.02, head, b" ")


def slow_headers(host: str, port: int, _: int, seconds: float) -> None:
    """Send 300 requests whose headers come at a byte every 5 s."""
    _hold(host, port, seconds, 300, 0.005, b"GET /api/state HTTP/1.1\r\nHost: x\r\nX-Long: ", b"a")


def guesses(host: str, port: int, _: int, seconds: float) -> None:
    """Send wrong tokens as fast as they are refused."""
    end = time.monotonic() + seconds
    for number in itertools.count():
        if time.monotonic() > end:
            return
        with contextlib.suppress(OSError, http.client.HTTPException):
            link = http.client.HTTPConnection(host, port, timeout=5)
            link.request("POST", "/api/login", json.dumps({"token": f"guess number {number}"}))
            link.getresponse().read()
            link.close()


def heartbeats(_: str, __: int, mavlink_port: int, seconds: float) -> None:
    """Send 3,000 heartbeats a second of another station."""
    coder = mav.MAVLink(None, 200, 190)
    message = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE, 3)
    packet = bytes(message.pack(coder))
    end = time.monotonic() + seconds
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        while time.monotonic() < end:
            for _i in range(30):
                station.sendto(packet, ("127.0.0.1", mavlink_port))
            time.sleep(0.01)


def small_chunks(host: str, port: int, _: int, seconds: float) -> None:
    """Send 20 endless bodies in chunks of a byte."""
    head = b"POST /api/login HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"
    _pour(host, port, seconds, head, b"1\r\n \r\n" * 2000)


def unread_answers(host: str, port: int, _: int, seconds: float) -> None:
    """Send requests on 20 connections, and read no answer."""
    _pour(host, port, seconds, b"", b"GET /page.js HTTP/1.1\r\nHost: x\r\n\r\n" * 500)


def cookies(host: str, port: int, _: int, seconds: float) -> None:
    """Send requests with a cookie of 60,000 backslashes."""
    cookie = b'Cookie: psiamfcpp_token="' + b"\\" * 60_000 + b'"\r\n'
    _ask(host, port, seconds, b"GET /api/state HTTP/1.1\r\nHost: x\r\n" + cookie + b"\r\n", reset=False)


def resets(host: str, port: int, _: int, seconds: float) -> None:
    """Send requests, and reset their connections at once."""
    _ask(host, port, seconds, b"GET /page.js HTTP/1.1\r\nHost: x\r\n\r\n", reset=True)


def many_stations(_: str, __: int, mavlink_port: int, seconds: float) -> None:
    """Send 1,000 commands a second, each from one of 200 ports."""
    coder = mav.MAVLink(None, 201, 190)
    params = (mav.MAVLINK_MSG_ID_CAMERA_SETTINGS, 0, 0, 0, 0, 0, 0)
    packet = bytes(mav.MAVLink_command_long_message(1, 100, mav.MAV_CMD_REQUEST_MESSAGE, 0, *params).pack(coder))
    end = time.monotonic() + seconds
    with contextlib.ExitStack() as stack:
        stations = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(200)]
        while time.monotonic() < end:
            for station in stations:
                station.sendto(packet, ("127.0.0.1", mavlink_port))
                time.sleep(0.001)


LOADS: dict[str, Callable[[str, int, int, float], None]] = {
    load.__name__: load
    for load in (
        silent_burst,
        silent_rate,
        slow_bodies,
        slow_headers,
        guesses,
        small_chunks,
        unread_answers,
        cookies,
        resets,
        heartbeats,
        many_stations,
    )
}


def _pour(host: str, port: int, seconds: float, head: bytes, again: bytes) -> None:
    """Send on 20 connections as much as they accept, and replace those that are closed."""
    end = time.monotonic() + seconds
    held: list[socket.socket] = []
    while time.monotonic() < end:
        while len(held) < 20:
            with contextlib.suppress(OSError):
                held.append(socket.create_connection((host, port), timeout=2))
                held[-1].sendall(head)
                held[-1].setblocking(False)
        for one in list(held):
            try:
                one.send(again)
            except BlockingIOError:
                pass
            except OSError:
                one.close()
                held.remove(one)
        time.sleep(0.001)
    for one in held:
        one.close()


def _ask(host: str, port: int, seconds: float, request: bytes, reset: bool) -> None:
    """Send requests as fast as possible; those that are not reset wait for their answer."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with contextlib.suppress(OSError), socket.create_connection((host, port), timeout=2) as one:
            one.sendall(request)
            if reset:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            else:
                one.recv(4096)


def _hold(host: str, port: int, seconds: float, count: int, pause_s: float, begun: bytes, more: bytes = b"") -> None:
    """Hold up to so many connections open for a time."""
    end, held = time.monotonic() + seconds, []
    at = time.monotonic()
    while time.monotonic() < end:
        if len(held) < count:
            with contextlib.suppress(OSError):
                held.append(socket.create_connection((host, port), timeout=2))
                held[-1].sendall(begun)
                held[-1].setblocking(False)
            time.sleep(pause_s)
        else:
            time.sleep(0.05)
        if time.monotonic() > at + 5:
            at = time.monotonic()
            held = [one for one in held if _goes_on(one, more)]
    for one in held:
        one.close()


def _goes_on(one: socket.socket, more: bytes) -> bool:
    try:
        if more:
            one.sendall(more)
        if one.recv(4096):
            return True
    except BlockingIOError:
        return True
    except OSError:
        pass
    one.close()
    return False


def measure(load: str, address: str, mavlink_port: int, token: str, seconds: float) -> dict[str, Any]:
    """Measure an operator with the token under a load: requests on new connections, WebSocket, MAVLink."""
    host, port = address.split(":")
    known = {"Authorization": f"Bearer {token}"}
    command = [sys.executable, __file__, load, host, port, str(mavlink_port), str(seconds)]
    gaps: list[float] = []
    done = threading.Event()
    watcher = threading.Thread(target=_watch, args=(address, known, gaps, done))
    watcher.start()
    waits, failures, unanswered, asked = [], 0, 0, 0
    with subprocess.Popen(command) as crowd, _Station(mavlink_port) as station:
        while crowd.poll() is None:
            start = time.monotonic()
            try:
                link = http.client.HTTPConnection(host, int(port), timeout=10)
                link.request("GET", "/api/state", headers=known)
                failures += link.getresponse().status != 200
                link.close()
            except (OSError, http.client.HTTPException):
                failures += 1
            waits.append(time.monotonic() - start)
            asked += 1
            unanswered += not station.answered()
            time.sleep(0.2)
    done.set()
    watcher.join(30)
    return {
        "requests": len(waits),
        "failed": failures,
        "longest_ms": round(1000 * max(waits)),
        "longest_socket_gap_ms": round(1000 * max(gaps, default=float("inf"))),
        "mavlink_unanswered": f"{unanswered} of {asked}",
    }


def _watch(address: str, known: dict[str, str], gaps: list[float], done: threading.Event) -> None:
    with connect(f"ws://{address}/api/live", additional_headers=known, max_size=None) as client:
        client.recv(timeout=30)
        last = time.monotonic()
        while not done.is_set():
            client.recv(timeout=30)
            now = time.monotonic()
            gaps.append(now - last)
            last = now


class _Station:
    """Ask for messages as a ground station, and count the answers that come within a second."""

    def __init__(self, port: int):
        self._coder, self._parser = mav.MAVLink(None, 255, 190), mav.MAVLink(None)
        self._parser.robust_parsing = True
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.settimeout(0.05)

    def __enter__(self) -> _Station:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def answered(self) -> bool:
        params = (mav.MAVLINK_MSG_ID_CAMERA_SETTINGS, 0, 0, 0, 0, 0, 0)
        ask = mav.MAVLink_command_long_message(1, 100, mav.MAV_CMD_REQUEST_MESSAGE, 0, *params)
        self._coder.seq = (self._coder.seq + 1) % 256
        self._socket.send(ask.pack(self._coder))
        end = time.monotonic() + 1
        while time.monotonic() < end:
            with contextlib.suppress(OSError):
                for message in self._parser.parse_buffer(self._socket.recv(2048)) or []:
                    if message.get_type() == "COMMAND_ACK" and message.target_system == 255:
                        return True
        return False


if __name__ == "__main__":
    name, host, port, mavlink_port, seconds = sys.argv[1:]
    if not ipaddress.ip_address(host).is_loopback:
        sys.exit("loopback addresses only: a server on this computer")
    LOADS[name](host, int(port), int(mavlink_port), float(seconds))
