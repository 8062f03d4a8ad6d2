"""HTTP connections on which nobody can send more than a request may hold, however it is split up.

The server parses what a connection sends in its one loop, before anything looks at tokens. Bodies of a byte a chunk, or
requests that are sent without reading any answer, would keep that loop from everybody else, and fill the memory.
"""

from __future__ import annotations

from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

# With the head, and whatever divides a body into parts, far more than any request needs.
_MOST_BYTES = 64 * 1024
_MOST_PARTS = 256
# What is read and thrown away, so that whoever sends too much can read why it is refused.
_MOST_DROPPED = 1024 * 1024


class _Connection(h11.Connection):
    """h11's parser, which gives up on bodies in many small parts."""

    _parts = 0

    def next_event(self) -> Any:
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._parts = 0
        elif isinstance(event, h11.Data):
            self._parts += 1
            if self._parts > _MOST_PARTS:
                raise h11.RemoteProtocolError("a body in too many parts")
        return event


class BoundedProtocol(H11Protocol):
    """uvicorn's protocol, which stops to parse what a client sends beyond a request of the largest size."""

    _unanswered = _dropped = 0
    """bytes since the last answer, and bytes that were not parsed"""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.conn = _Connection(h11.SERVER, _MOST_BYTES)

    def data_received(self, data: bytes) -> None:
        """Parse what comes; drop what is too much, and close the connection once an answer was sent, or at once."""
        room = 0 if self._dropped else _MOST_BYTES - self._unanswered
        self._unanswered += len(data)
        if room > 0:
            super().data_received(data[:room])
        if len(data) <= room or self.transport.is_closing():
            return
        self._dropped += len(data) - max(room, 0)
        if self.cycle is not None and self._dropped <= _MOST_DROPPED:
            self.cycle.keep_alive = False
        else:
            self.transport.abort()

    def eof_received(self) -> bool | None:  # type: ignore[override]
        """Answer a whole request although its sender will say no more."""
        cycle = self.cycle
        if cycle is None or cycle.more_body or cycle.response_started:
            return None
        cycle.keep_alive = False
        return True

    def on_response_complete(self) -> None:
        """Go on with the next request, which may have come already."""
        self._unanswered = len(self.conn.trailing_data[0])
        super().on_response_complete()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP; without a word where an answer was sent already."""
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            super().send_400_response(msg)
        else:
            self.transport.close()
