"""Our trackers as TraX workers, for vot-toolkit and every other TraX client."""

from __future__ import annotations

from typing import Any, BinaryIO, Protocol

from numpy.typing import ArrayLike

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image
from psiamfcpp.trackers.adapters.trax_worker import Properties, ProtocolError, Session, claim_streams
from psiamfcpp.trackers.trax.images import decode_image
from psiamfcpp.version import __version__

_IMAGES = ("path", "url", "memory", "data")


class _Following(Protocol):
    """What is needed of a tracker here: two calls of `psiamfcpp.trackers.contract.Tracker`."""

    def init(self, frame: Image, box: ArrayLike) -> Any: ...

    def update(self, frame: Image) -> Any: ...


def serve_trax(tracker: _Following, name: str, streams: tuple[BinaryIO, BinaryIO] | None = None) -> None:
    """Answer a TraX client until it quits or closes the connection.

    The reply to a frame carries the score as property ``confidence`` and the state as property ``state``, where the
    tracker has them. Images are taken by path, URL, in memory and as encoded data; regions of all kinds, of which
    the box about them is followed.

    Args:
        tracker: ours, open.
        name: what the client calls it.
        streams: to read messages from and to write them to. By default standard input and output, or the connection
            that ``TRAX_SOCKET`` asks for; whatever else is printed goes to standard error then.

    Raises:
        UserError: the client broke the protocol, or sent a frame or box that the tracker refuses; it is sent a quit
            with the reason.
    """
    describe = {"trax.description": f"psiamfcpp {__version__}", "trax.family": "psiamfcpp"}
    session = Session(streams or claim_streams(), name, _IMAGES, decode_image, describe)

    def init(frame: Image, box: Box) -> tuple[Box, Properties]:
        return _answer(tracker.init(frame, box))

    def update(frame: Image) -> tuple[Box, Properties]:
        return _answer(tracker.update(frame))

    try:
        session.run(init, update)
    except ProtocolError as error:
        raise UserError(f"the TraX client broke the protocol: {error}") from None
    except Exception as error:
        session.fail(str(error))
        raise


def _answer(track: Any) -> tuple[Box, Properties]:
    properties: Properties = {}
    if track.score is not None:
        properties["confidence"] = repr(float(track.score))
    if track.state is not None:
        properties["state"] = track.state
    return track.box, properties
