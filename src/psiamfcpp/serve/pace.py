"""WebSockets that know how far their client has read, so that what is sent next can be the newest there is.

Whatever is sent lies in buffers of both systems until it is read: to a client that reads one message of thirty, minutes
of them. TCP does not tell; but a client answers a ping once it has read what came before it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from fastapi import WebSocket
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

_EXTENSION = "psiamfcpp.caught_up"
# On a link of 100 ms there and back these are forty messages a second.
_MOST_UNREAD = 4


class PacedProtocol(WebSocketsSansIOProtocol):
    """uvicorn's protocol, with a ping behind each message; `caught_up` waits for the answers."""

    _sent = _read = 0

    async def run_asgi(self) -> None:
        """Serve the connection, to which the application can ask `caught_up`."""
        self._changed = asyncio.Event()
        scope: Any = self.scope
        scope["extensions"][_EXTENSION] = self._caught_up
        await super().run_asgi()

    async def send(self, message: Any) -> None:
        """Send, and ask to be told when it was read."""
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
