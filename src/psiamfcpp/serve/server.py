"""Runs the application until a signal ends it."""

from __future__ import annotations

import logging
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import uvicorn

from psiamfcpp.errors import UserError
from psiamfcpp.serve.bounds import BoundedProtocol
from psiamfcpp.serve.follower import Follower
from psiamfcpp.serve.gate import Listener
from psiamfcpp.serve.guard import Guard
from psiamfcpp.serve.pace import PacedProtocol

# One that asks nothing for twice so long, or takes nothing, must not keep others out.
_SILENT_S = 5
_ACCEPTED_AT_ONCE = 8
_TAKES_NOTHING_MS = 20_000
# What the system may hold back for a client that reads slowly: some images, not seconds of them.
_SEND_BUFFER = 256 * 1024


def bind(host: str, port: int) -> Listener:
    """A socket that listens; port 0 takes a free one.

    Raises:
        UserError: the address is not one of this machine, or the port is taken or out of range.
    """
    if not 0 <= port <= 65535:
        # the system would take what is left of it after division by 65536
        raise UserError(f"cannot listen on {host} port {port}: a port is a number from 0 to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = Listener(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
            if hasattr(socket, "TCP_USER_TIMEOUT"):  # not everywhere
                listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _TAKES_NOTHING_MS)
            listener.bind(address)
        except BaseException:
            listener.close()
            raise
    except (OSError, OverflowError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"cannot listen on {host} port {port}: {reason}; choose another --port or --host") from None
    return listener


def make_server(app: Guard, ready: Callable[[], None] = lambda: None) -> uvicorn.Server:
    """The server of an application, with its limits; ``ready`` is called once, when connections are taken."""

    async def sweep() -> None:
        app.gate.sweep(2 * _SILENT_S)

    config = uvicorn.Config(
        app,
        # others accept connections, and parse requests, in ways of their own
        loop="asyncio",
        http=BoundedProtocol,
        # those that come at once are taken in small lots, between which the others are served
        backlog=_ACCEPTED_AT_ONCE,
        log_level="error",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        lifespan="on",
        ws=PacedProtocol,
        ws_max_size=4096,
        ws_max_queue=8,
        # behind the images that a slow link has still to carry, an answer takes its time
        ws_ping_interval=10.0,
        ws_ping_timeout=30.0,
        ws_per_message_deflate=False,  # images are compressed already
        timeout_keep_alive=_SILENT_S,
        callback_notify=sweep,
        timeout_notify=1,
        timeout_graceful_shutdown=2,
    )
    # What clients do wrong is no fault of the server, and would fill the log for whoever knocks.
    logging.getLogger("uvicorn.error").addFilter(_own_fault)
    return _Server(config, ready)


def _own_fault(record: logging.LogRecord) -> bool:
    """Whether a line of uvicorn's log is of a fault of ours: in the application, or in starting and ending it."""
    return str(record.msg).startswith(("Exception in ASGI", "Exception in 'lifespan'", "Application "))


def run(server: uvicorn.Server, listener: Listener, follower: Follower) -> None:
    """Serve until SIGINT or SIGTERM, until ``server.should_exit`` is set, or until following fails.

    Args:
        server: what `make_server` gave.
        listener: what `bind` gave; closed at the end.
        follower: what is served; its failure is raised here.
    """

    def check() -> None:
        if follower.failure is not None:
            server.should_exit = True

    guard: Any = server.config.app
    listener.gate = guard.gate
    follower.listeners.append(check)
    try:
        with _quiet_signals():
            server.run([listener])
    finally:
        follower.listeners.remove(check)
        listener.close()
    if follower.failure is not None:
        raise follower.failure


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, ready: Callable[[], None]):
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            self._ready()


@contextmanager
def _quiet_signals() -> Iterator[None]:
    """The server raises the signal that ended it once more, when all is closed; by then it has done its work."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {kind: signal.signal(kind, lambda *_: None) for kind in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)
