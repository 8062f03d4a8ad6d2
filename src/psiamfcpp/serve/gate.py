"""Who may stay connected: connections are few, and those that have not shown that they may come in go first.

A process may hold some number of files open, often 1,024. Connections that say nothing must not use them up, for the
camera, a recording and the operator need theirs.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

# Each costs some 20 KiB; no operator needs a tenth of them.
_MOST = 512
# Of the files that the process may open, connections take this share at most.
_SHARE = 0.5
# Connections that the system completes before they are accepted. In a flood the operator's waits among them: with a
# short queue its first packet would be dropped, and sent again after a second.
_WAITING = 1024
# When there are too many, this share of them is closed at once, so that the search for them is rare.
_CLOSED_AT_ONCE = 0.125

Client = Any


@dataclass(eq=False)
class _Visitor:
    connection: socket.socket
    address: str
    since: float
    """when it came, or when its last request was answered"""
    serving: int = 0
    """requests of it that are being answered"""
    proven: bool = False
    """it made a whole request and, where there is one, knew the token"""


class Gate:
    """Counts connections, and closes those that keep others out."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._visitors: dict[Client, _Visitor] = {}
        self.most = max(8, min(_MOST, int(_SHARE * _file_limit())))

    def admit(self, connection: socket.socket, client: Client) -> bool:
        """Count a new connection in, at the cost of older ones where there are too many.

        Of those that have proven nothing, the oldest of the address that has most go, then connections without a
        request. So whoever floods the server pushes out its own connections, and the operator's stay.

        Args:
            connection: the connection, which stays the caller's.
            client: host and port of the other end.

        Returns:
            False where it must be closed, for all others are being served.
        """
        if len(self._visitors) >= self.most:
            self._forget_closed()
        if len(self._visitors) >= self.most and not self._make_room():
            return False
        self._visitors[client] = _Visitor(connection, str(client[0]), self._clock())
        return True

    @contextmanager
    def serving(self, client: Client) -> Iterator[None]:
        """Know that a client is being served while the block runs; it is not silent then."""
        visitor = self._visitors.get(client)
        if visitor is None:
            yield
            return
        visitor.serving += 1
        try:
            yield
        finally:
            visitor.serving -= 1
            visitor.since = self._clock()

    def prove(self, client: Client) -> None:
        """Note that a client made a whole request, and knew the token."""
        if client in self._visitors:
            self._visitors[client].proven = True

    def sweep(self, silent_s: float) -> None:
        """Close connections on which no whole request came for so many seconds; none is made longer by single bytes."""
        self._forget_closed()
        now = self._clock()
        for client, visitor in list(self._visitors.items()):
            if not visitor.serving and now - visitor.since > silent_s:
                self._close(client)

    def _make_room(self) -> bool:
        count = max(1, int(_CLOSED_AT_ONCE * self.most))
        unproven = [(client, visitor) for client, visitor in self._visitors.items() if not visitor.proven]
        if unproven:
            ((address, _),) = Counter(visitor.address for _, visitor in unproven).most_common(1)
            going = [(client, visitor) for client, visitor in unproven if visitor.address == address]
        else:
            going = [(client, visitor) for client, visitor in self._visitors.items() if not visitor.serving]
        going.sort(key=lambda found: found[1].since)
        # never more than half of an address: a lone operator's connection is not worth a place to a crowd
        for client, _ in going[: min(count, max(1, len(going) // 2))]:
            self._close(client)
        return bool(going)

    def _close(self, client: Client) -> None:
        # not `close`, since the server's loop still watches it, and closes it once it reads the end
        with contextlib.suppress(OSError):
            self._visitors.pop(client).connection.shutdown(socket.SHUT_RDWR)

    def _forget_closed(self) -> None:
        self._visitors = {
            client: visitor for client, visitor in self._visitors.items() if visitor.connection.fileno() >= 0
        }


class Listener(socket.socket):
    """A listening socket that accepts what its gate admits, and never fails for want of files."""

    gate: Gate | None = None
    _spare = -1

    def listen(self, backlog: int = 0, /) -> None:
        """Listen with a queue that bears a flood, whatever the server asks for."""
        self._spare = os.open(os.devnull, os.O_RDONLY)
        super().listen(_WAITING)

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection.

        Raises:
            ConnectionAbortedError: it was closed at once, which servers bear.
        """
        try:
            connection, address = super().accept()
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE):
                raise
            self._turn_away()
            raise ConnectionAbortedError("no file is left for it") from None
        if self.gate is not None and not self.gate.admit(connection, address[:2]):
            connection.close()
            raise ConnectionAbortedError("there are too many")
        return connection, address

    def close(self) -> None:
        """Stop listening."""
        if self._spare >= 0:
            os.close(self._spare)
            self._spare = -1
        super().close()

    def _turn_away(self) -> None:
        """Take the next connection with the file that is kept for this, and close it: unheard, it would wait on."""
        if self._spare >= 0:
            os.close(self._spare)
        with contextlib.suppress(OSError):
            super().accept()[0].close()
        try:
            self._spare = os.open(os.devnull, os.O_RDONLY)
        except OSError:
            self._spare = -1


def _file_limit() -> int:
    """How many files this process may have open."""
    try:
        import resource
    except ImportError:  # not everywhere
        return 2 * _MOST
    soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return 2 * _MOST if soft == resource.RLIM_INFINITY else soft
