"""Who may stay connected: connections are few, and those that have not shown that they may come in go first.

A process may hold some number of files open, often 1,024. Connections that say nothing must not use them up, for the
camera, a recording and the operator need theirs.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import time
import weakref
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
# Connections that are taken, and looked at, in a row, before the server's loop goes on. More are looked at, so that
# those which have left again never become many.
_TAKEN, _LOOKED_AT = 64, 192
# What ends the head of a request; one that is longer is for the server to refuse.
_HEAD_ENDS = (b"\n\r\n", b"\n\n")
_LONGEST_HEAD = 16 * 1024
# When there are too many, this share of them is closed at once, so that the search for them is rare.
_CLOSED_AT_ONCE = 0.125

Client = Any


@dataclass(eq=False)
class _Visitor:
    connection: socket.socket
    address: str
    since: float
    """when it came, or when its last request was answered"""
    handed: bool = False
    """the server's loop watches it; else it waits in the listener"""
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

    def hand(self, client: Client) -> None:
        """Note that a connection is the server's from now on."""
        if client in self._visitors:
            self._visitors[client].handed = True

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
        """Close connections on which no whole request came in time; none is made longer by single bytes."""
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
        visitor = self._visitors.pop(client)
        with contextlib.suppress(OSError):
            if visitor.handed:
                # not `close`, since the server's loop watches it, and closes it once it reads the end
                visitor.connection.shutdown(socket.SHUT_RDWR)
            else:
                with contextlib.suppress(BlockingIOError):
                    # what is unread would make the system reset the connection
                    visitor.connection.recv(_LONGEST_HEAD)
                visitor.connection.close()

    def _forget_closed(self) -> None:
        self._visitors = {
            client: visitor for client, visitor in self._visitors.items() if visitor.connection.fileno() >= 0
        }


class Listener(socket.socket):
    """A listening socket whose connections wait until they have sent the head of a request, and then are accepted.

    The newest is accepted first: in a flood that the server cannot keep up with, the oldest wait in vain, be it in a
    queue or not, and whoever comes now is served at once. Newcomers are taken before anybody is accepted, since those
    for whom the system's queue has no room try again a second later.

    A connection that says nothing costs a twentieth of one that the server's loop has taken over. So the socket that
    the loop watches (`fileno`) is a set of all those that wait (epoll), where the system has such; elsewhere
    connections are accepted at once. Which may wait is for the gate to say; a lack of files is no failure.
    """

    gate: Gate | None = None
    _spare = _bell = -1
    _poll: Any = None

    def listen(self, backlog: int = 0, /) -> None:
        """Listen with a queue that bears a flood, whatever the server asks for."""
        self._spare = os.open(os.devnull, os.O_RDONLY)
        self._waiting: dict[int, tuple[socket.socket, Any]] = {}
        self._ready: list[tuple[socket.socket, Any]] = []
        # those that have sent a part of a head
        self._begun: weakref.WeakSet[socket.socket] = weakref.WeakSet()
        super().listen(_WAITING)
        if hasattr(select, "epoll"):
            self._poll = select.epoll()
            self._poll.register(super().fileno(), select.EPOLLIN)
            # rings as long as somebody can be accepted
            self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
            self._poll.register(self._bell, select.EPOLLIN)

    def fileno(self) -> int:
        """What becomes readable when `accept` has something to give."""
        return super().fileno() if self._poll is None else int(self._poll.fileno())

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection that has sent the head of a request.

        Raises:
            BlockingIOError: there is none now.
        """
        if self._poll is None:
            return self._take()
        self._look()
        while self._ready:
            connection, address = self._ready.pop()
            if connection.fileno() >= 0:  # else the gate closed it meanwhile
                if self.gate is not None:
                    self.gate.hand(address[:2])
                return connection, address
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._bell)
        raise BlockingIOError("nobody has said anything")

    def close(self) -> None:
        """Stop listening, and close what waits."""
        if self._spare >= 0:
            os.close(self._spare)
            self._spare = -1
            for connection, _ in (*self._waiting.values(), *self._ready):
                connection.close()
        if self._poll is not None:
            os.close(self._bell)
            self._poll.close()
            self._poll = None
        super().close()

    def _look(self) -> None:
        """Let newcomers wait, then collect those that have sent what is needed."""
        for _ in range(_TAKEN):
            try:
                connection, address = self._take()
            except ConnectionAbortedError:
                continue
            except OSError:
                break
            connection.setblocking(False)
            self._waiting[connection.fileno()] = (connection, address)
            self._poll.register(connection.fileno(), select.EPOLLIN)
        for number, news in self._poll.poll(0, _LOOKED_AT):
            if number in self._waiting:
                self._consider(number, bool(news & (select.EPOLLHUP | select.EPOLLERR)))

    def _consider(self, number: int, reset: bool) -> None:
        """Accept, keep or drop a connection of which there is news."""
        connection, address = self._waiting[number]
        sent = b""
        if not reset:  # what was sent before a reset could still be read, but nobody is there to be answered
            with contextlib.suppress(OSError):
                sent = connection.recv(_LONGEST_HEAD, socket.MSG_PEEK)
        if not sent:  # the other end has left
            del self._waiting[number]
            connection.close()
        elif len(sent) == _LONGEST_HEAD or any(end in sent for end in _HEAD_ENDS):
            self._poll.unregister(number)
            del self._waiting[number]
            self._ready.append((connection, address))
            os.eventfd_write(self._bell, 1)
        elif connection not in self._begun:
            # what is there already is no news any more; the next byte is
            self._poll.modify(number, select.EPOLLIN | select.EPOLLET)
            self._begun.add(connection)

    def _take(self) -> tuple[socket.socket, Any]:
        """The next connection that the gate admits; ConnectionAbortedError for one that was closed at once."""
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
        if self.gate is not None and self._poll is None:
            self.gate.hand(address[:2])
        return connection, address

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
