"""Bytes to and from ground stations and autopilots, by UDP or a serial line, however often the other end leaves."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from psiamfcpp.errors import UserError
from psiamfcpp.serve.limits import Bucket, Buckets

_FORMS = "udpout:HOST:PORT, udpin:HOST:PORT or serial:DEVICE[:BAUD]"
_SERIAL_BAUD = 57600
_MOST_PEERS = 16
_PEER_S = 15.0
_REOPEN_S = 1.0
# A ground station and an autopilot send some dozens of packets a second; more would take time from the tracker. Each
# peer has its own share, so that a flood of one costs no other a command; those not yet known share what is left,
# by address and in all.
_PEER_PER_S, _STRANGER_PER_S, _STRANGERS_PER_S = 500.0, 100.0, 300.0
_BUFFER = 2**20
_MARKS = (0xFD, 0xFE)

Peer = Any


class Link(Protocol):
    """A way to other MAVLink systems."""

    whole: bool
    """what `receive` gives are whole packets, not parts of a stream"""

    def receive(self, timeout: float) -> tuple[bytes, Peer] | None:
        """Bytes and where they came from; None if none came in time."""
        ...

    def accept(self, peer: Peer, commands: bool = False) -> None:
        """Note that a peer sent MAVLink, so that it is spoken to from now on; ``commands``: it commanded us."""
        ...

    def send(self, data: bytes) -> None:
        """To all peers; what cannot be sent is lost."""
        ...

    def close(self) -> None:
        """Release port or device."""
        ...


def open_link(text: str) -> Link:
    """Open what a text names.

    Args:
        text: ``udpout:HOST:PORT`` sends there; ``udpin:HOST:PORT`` waits for others and answers all who speak
            MAVLink; ``serial:DEVICE[:BAUD]`` is a serial line.

    Raises:
        UserError: the text names no link, or it cannot be opened.
    """
    kind, _, rest = text.partition(":")
    if kind == "serial" and rest:
        device, _, baud = rest.partition(":")
        if baud and not baud.isdecimal():
            raise UserError(f"mavlink {text}: {baud!r} is no baud rate")
        return SerialLink(device, int(baud) if baud else _SERIAL_BAUD)
    host, _, port = rest.rpartition(":")
    if kind not in ("udpout", "udpin") or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise UserError(f"mavlink {text!r} is no link: give {_FORMS}")
    try:
        return UdpLink(host.strip("[]"), int(port), listen=kind == "udpin")
    except (OSError, UnicodeError) as error:
        raise UserError(f"mavlink {text} cannot be opened: {getattr(error, 'strerror', None) or error}") from None


class UdpLink:
    """See `Link`."""

    whole = True

    def __init__(self, host: str, port: int, listen: bool, clock: Callable[[], float] = time.monotonic):
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._clock = clock
        self._fixed = None if listen else address
        self._lock = threading.Lock()
        self._peers: dict[Peer, _Seen] = {}
        self._by_peer = Buckets(_PEER_PER_S, _PEER_PER_S, clock)
        self._by_address = Buckets(_STRANGER_PER_S, _STRANGER_PER_S, clock)
        self._strangers = Bucket(_STRANGERS_PER_S, _STRANGERS_PER_S, clock)
        self._socket = socket.socket(family, kind, protocol)
        with contextlib.suppress(OSError):
            # a flood that comes while the processor is busy otherwise must not push out the rest
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        if listen:
            try:
                self._socket.bind(address)
            except BaseException:
                self._socket.close()
                raise

    def receive(self, timeout: float) -> tuple[bytes, Peer] | None:
        """See `Link`."""
        end = time.monotonic() + timeout
        while True:
            self._socket.settimeout(max(end - time.monotonic(), 0.001))
            try:
                data, peer = self._socket.recvfrom(2048)
            except OSError:
                # nothing in time; or nobody was there for what was sent last, which UDP reports here
                return None
            # cheaply, before anything is parsed
            if data and data[0] in _MARKS and self._allowed(peer):
                return data, peer
            if time.monotonic() >= end:
                return None

    def accept(self, peer: Peer, commands: bool = False) -> None:
        """See `Link`; where there are too many, one that never commanded goes, of the address that has most.

        Of several such, the one that came last: so whoever speaks from ever new ports pushes out itself.
        """
        with self._lock:
            now = self._clock()
            seen = self._peers.get(peer)
            if seen is None and len(self._peers) >= _MOST_PEERS:
                ports = Counter(address for address, *_ in self._peers)
                del self._peers[
                    max(
                        self._peers,
                        key=lambda one: (ports[one[0]], not self._peers[one].commands, self._peers[one].since),
                    )
                ]
            since = now if seen is None else seen.since
            self._peers[peer] = _Seen(since, now, commands or (seen is not None and seen.commands))

    def send(self, data: bytes) -> None:
        """See `Link`; may be called in any thread."""
        with self._lock:
            now = self._clock()
            self._peers = {peer: seen for peer, seen in self._peers.items() if now - seen.at < _PEER_S}
            peers = {self._fixed, *self._peers} - {None}
        for peer in peers:
            with contextlib.suppress(OSError):  # nobody there, or no route: it may come back
                self._socket.sendto(data, peer)

    def close(self) -> None:
        """See `Link`."""
        self._socket.close()

    def _allowed(self, peer: Peer) -> bool:
        if not self._by_peer.take(peer):
            return False
        return peer in self._peers or peer == self._fixed or (self._by_address.take(peer[0]) and self._strangers.take())


class _Seen(NamedTuple):
    since: float
    at: float
    commands: bool


class SerialLink:
    """See `Link`; a device that is unplugged is opened again when it is back."""

    whole = False

    def __init__(self, device: str, baud: int):
        """Open the device.

        Raises:
            UserError: it cannot be opened.
        """
        import serial

        self._serial = serial
        self._device, self._baud = device, baud
        self._tried = 0.0
        try:
            self._port = self._open()
        except (serial.SerialException, OSError, ValueError) as error:
            raise UserError(f"mavlink serial:{device} cannot be opened: {error}") from None

    def receive(self, timeout: float) -> tuple[bytes, Peer] | None:
        """See `Link`."""
        if self._port is None:
            self._reopen(timeout)
            return None
        try:
            self._port.timeout = timeout
            first = self._port.read(1)
            data = first + self._port.read(min(self._port.in_waiting, 2048)) if first else b""
        except (self._serial.SerialException, OSError, TypeError):
            self.close()
            return None
        return (data, self._device) if data else None

    def accept(self, peer: Peer, commands: bool = False) -> None:
        """See `Link`."""

    def send(self, data: bytes) -> None:
        """See `Link`."""
        if self._port is None:
            return
        try:
            self._port.write(data)
        except self._serial.SerialTimeoutException:
            # the other end takes nothing: what is old would not help it later
            self._port.reset_output_buffer()
        except (self._serial.SerialException, OSError):
            self.close()

    def close(self) -> None:
        """See `Link`."""
        if self._port is not None:
            with contextlib.suppress(self._serial.SerialException, OSError):
                self._port.close()
            self._port = None

    def _open(self):  # type: ignore[no-untyped-def]
        return self._serial.Serial(self._device, self._baud, timeout=0.05, write_timeout=0.2)

    def _reopen(self, timeout: float) -> None:
        time.sleep(timeout)
        now = time.monotonic()
        if now - self._tried < _REOPEN_S:
            return
        self._tried = now
        with contextlib.suppress(self._serial.SerialException, OSError, ValueError):
            self._port = self._open()
