"""WebSockets that know how far their client has read, so that what is sent next can be the newest there is.

Whatever is sent lies in buffers of both systems until it is read: to a client that reads one message of thirty, minutes
of them. TCP does not say so; but a client answers a ping once it has read what came before it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from fastapi import WebSocket
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.protocol import State

from psiamfcpp.serve.limits import Bucket

_EXTENSION = "psiamfcpp.caught_up"
# On a link of 100 ms there and back these are forty messages a second.
_MOST_UNREAD = 4


# Bytes per second of a client, and at once: many times what the busiest page sends. All of what comes at once is parsed
# before anybody else is served, so it is looked at in slices.
_BYTES_PER_S, _BYTES_AT_ONCE = 16 * 1024.0, 32 * 1024.0
_SLICE = 4096
# Parts of a message; a part may be empty, so that the size of the message does not limit their number.
_MOST_PARTS = 64


class PacedProtocol(WebSocketsSansIOProtocol):
    """uvicorn's protocol, with a ping behind each message; `caught_up` waits for the answers.

    A client that sends much more than any page does is sent away.
    """

    _sent = _read = 0

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._bytes = Bucket(_BYTES_PER_S, _BYTES_AT_ONCE)

    def data_received(self, data: bytes) -> None:
        """Parse what comes, slice by slice, until it is too much."""
        if not self.handshake_initiated:  # the head of the request, whose size is limited already
            super().data_received(data)
            return
        for start in range(0, len(data), _SLICE):
            part = data[start : start + _SLICE]
            if self.transport.is_closing():
                return
            if self._bytes.take(len(part)):
                super().data_received(part)
            else:
                self._send_away("too many bytes")

    def handle_cont(self, event: Any) -> None:
        """A further part of a message."""
        if len(self.frames) >= _MOST_PARTS:
            self._send_away("a message in too many parts")
        else:
            super().handle_cont(event)

    def _send_away(self, reason: str) -> None:
        if self.conn.state is State.OPEN:
            self.conn.send_close(1008, reason)
            self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        self.transport.close()

    async def run_asgi(self) -> None:
        """Serve the connection, to which the application can ask `caught_up`."""
        self._changed = asyncio.Event()
        scope: Any = self.scope
        scope["extensions"][_EXTENSION] = self._caught_up
        await super().run_asgi()

    async def send(self, message: Any) -> None:
        """Send, and ask for an answer once it was read."""
        await super().send(message)
        if message["type"] == "websocket.send" and not self.transport.is_closing():
            self._sent += 1
            self.conn.send_ping(self._sent.to_bytes(8, "big"))
            self.transport.write(b"".join(self.conn.data_to_send()))

    def handle_pong(self, event: Any) -> None:
        """An answer: to a ping of ours, or to one of uvicorn's, which are shorter."""
        if len(event.data) == 8:
            # a client may answer the last of several pings only, and a hostile one what was never asked
            self._read = min(self._sent, max(self._read, int.from_bytes(event.data, "big")))
            self._changed.set()
        else:
            super().handle_pong(event)

    async def _caught_up(self) -> None:
        while self._sent - self._read >= _MOST_UNREAD:
            self._changed.clear()
            await self._changed.wait()


def caught_up(socket: WebSocket) -> Callable[[], Awaitable[None]]:
    """What waits until a client has read all but the last few messages; at once with another server than ours."""
    given: Callable[[], Awaitable[None]] | None = socket.scope["extensions"].get(_EXTENSION)
    return given or (lambda: asyncio.sleep(0))
