"""A TraX server in one file, for trackers that live in an interpreter of their own.

It needs Python 3.6 and NumPy and imports nothing else of this package, so that an adapter can run it in the
environment of the tracker. The protocol is TraX, version 4 (https://trax.readthedocs.io, "TraX protocol
specification"): one message per line on standard input and output, prefixed with ``@@TRAX:``.

What the tracker prints goes to standard error: `claim_streams` gives standard output to the protocol alone.
"""

import base64
import os
import re
import socket
import sys
from typing import Any, BinaryIO, Callable, Dict, List, NamedTuple, Optional, Tuple

import numpy as np

VERSION = 4
PREFIX = "@@TRAX:"
_TOKEN = re.compile(r'"([^"\\]*(?:\\.[^"\\]*)*)"|(\S+)', re.DOTALL)
_PROPERTY = re.compile(r"([A-Za-z0-9._]{1,64})=(.*)", re.DOTALL)
_ESCAPE = re.compile(r"\\(.)", re.DOTALL)

Box = Tuple[float, float, float, float]
Properties = Dict[str, str]


class ProtocolError(Exception):
    """A message that breaks the protocol; its text is one line."""


class Message(NamedTuple):
    """One line of the protocol."""

    kind: str
    """hello, initialize, frame, state or quit"""
    arguments: List[str]
    """what the kind demands, such as an image or a region"""
    properties: Properties
    """``key=value``"""


def split_message(line: bytes) -> Optional[Message]:
    """Return the message of a line, or None where the line is output of the tracker and no message.

    Raises:
        ProtocolError: the line has the prefix and cannot be read.
    """
    text = line.decode("utf-8", "surrogateescape")
    # a tracker may have printed something without a line feed before
    start = text.find(PREFIX)
    if start < 0:
        return None
    kind, _, rest = text[start + len(PREFIX) :].rstrip().partition(" ")
    if not kind.isalpha():
        raise ProtocolError(f"message {text[start:]!r:.40} has no name")
    arguments: List[str] = []
    properties: Properties = {}
    place = 0
    for token in _TOKEN.finditer(rest):
        if rest[place : token.start()].strip():
            break
        place = token.end()
        quoted, bare = token.groups()
        # without quotes a back-slash may belong to a path
        value = bare if quoted is None else _ESCAPE.sub(_unescaped, quoted)
        pair = _PROPERTY.fullmatch(value)
        if pair:
            properties[pair.group(1)] = pair.group(2)
        else:
            arguments.append(value)
    return Message(kind, arguments, properties)


def _unescaped(found: "re.Match[str]") -> str:
    return "\n" if found.group(1) == "n" else found.group(1)


def join_message(kind: str, arguments: Optional[List[str]] = None, properties: Optional[Properties] = None) -> bytes:
    """Return the line of a message, line feed included; the inverse of `split_message`."""
    pairs = [f"{key}={value}" for key, value in (properties or {}).items()]
    words = "".join(f' "{_escaped(word)}"' for word in (arguments or []) + pairs)
    return (PREFIX + kind + words + "\n").encode("utf-8", "surrogateescape")


def _escaped(word: str) -> str:
    return word.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def write_rectangle(box: Any) -> str:
    """Return ``left,top,width,height`` in all digits."""
    return ",".join(repr(float(value)) for value in box)


def read_region(text: str) -> Optional[Box]:
    """Return the box ``(x, y, w, h)`` of a region; None for a special region, one number that is no place.

    A rectangle is ``left,top,width,height``; of a polygon ``x,y,x,y,...`` and a mask ``mask:x,y,w,h,counts...``
    it is the box about them. Counts alternate between absent and present pixels, row by row, absent first.

    Raises:
        ProtocolError: no such region, an empty mask, or a number that is not finite.
    """
    text = text.strip()
    if text.startswith("mask:"):
        return _mask_box(_numbers(text[5:], text))
    values = _numbers(text, text)
    if values.size == 1:
        return None
    if values.size == 4:
        x, y, w, h = values
        if w < 0 or h < 0:
            raise ProtocolError(f"region {text!r:.60} has a negative side")
    elif values.size >= 6 and values.size % 2 == 0:
        (x, y), (right, bottom) = values.reshape(-1, 2).min(axis=0), values.reshape(-1, 2).max(axis=0)
        w, h = right - x, bottom - y
    else:
        raise ProtocolError(f"region {text!r:.60} has {values.size} numbers")
    return (float(x), float(y), float(w), float(h))


def _numbers(text: str, region: str) -> Any:
    try:
        values = np.array([float(part) for part in text.strip(" ,;").split(",")])
    except ValueError:
        raise ProtocolError(f"{region!r:.60} is no region") from None
    if not np.isfinite(values).all():
        raise ProtocolError(f"region {region!r:.60} is not finite")
    return values


def _mask_box(values: Any) -> Box:
    values = values.astype(np.int64)
    if values.size < 4 or (values[2:] < 0).any() or values[2] * values[3] > 1 << 28:
        raise ProtocolError("a mask needs x,y,w,h and counts")
    x, y, w, h = (int(value) for value in values[:4])
    counts = values[4:]
    if counts.sum() > w * h:
        raise ProtocolError(f"a mask of {w} by {h} has more pixels than that")
    present = np.repeat(np.arange(counts.size) % 2 == 1, counts)
    mask = np.concatenate([present, np.zeros(w * h - present.size, bool)]).reshape(h, w)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not rows.size:
        raise ProtocolError("an empty mask is no place")
    top, left = int(rows[0]), int(columns[0])
    return (float(x + left), float(y + top), float(columns[-1] + 1 - left), float(rows[-1] + 1 - top))


def read_memory_image(text: str) -> Any:
    """Return an image ``(H, W, 3)`` uint8, RGB, from ``image:width;height;format;base64``.

    Formats are rgb, gray8 and gray16 (little-endian; its upper byte is kept).

    Raises:
        ProtocolError: another kind of image, or a size that its data do not have.
    """
    if not text.startswith("image:"):
        raise ProtocolError(f"image {text!r:.40} is not in memory (image:...): this tracker takes no other")
    try:
        width, height, form, data = text[6:].split(";", 3)
        bytes_each = {"rgb": 3, "gray8": 1, "gray16": 2}[form]
        shape = (int(height), int(width), bytes_each)
        if min(shape) < 1:
            raise ValueError("no pixels")
        pixels = np.frombuffer(base64.b64decode(data), np.uint8).reshape(shape)
    except (KeyError, ValueError):
        raise ProtocolError(f"image {text!r:.40} cannot be decoded") from None
    return pixels if form == "rgb" else np.repeat(pixels[:, :, -1:], 3, axis=2)


def claim_streams() -> Tuple[BinaryIO, BinaryIO]:
    """Return the streams of the protocol, and point standard output to standard error for everybody else.

    With ``TRAX_SOCKET`` set to a port, the protocol runs over a connection to that port of this machine.
    """
    port = os.environ.get("TRAX_SOCKET")
    if port:
        connection = socket.create_connection(("127.0.0.1", int(port)))
        return os.fdopen(os.dup(connection.fileno()), "rb"), os.fdopen(connection.detach(), "wb", 0)
    source, sink = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb", 0)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return source, sink


class Session:
    """The server's side of one conversation, which ends at `quit` or at the end of the input.

    Args:
        streams: what to read messages from and to write them to, as `claim_streams` gives them.
        name: of the tracker.
        images: kinds of image that `decode` can read: path, memory, data, url.
        decode: makes an image of its text.
        describe: more of the hello message, such as ``trax.description``.
    """

    def __init__(
        self,
        streams: Tuple[BinaryIO, BinaryIO],
        name: str,
        images: Tuple[str, ...] = ("memory",),
        decode: Callable[[str], Any] = read_memory_image,
        describe: Optional[Properties] = None,
    ) -> None:
        self._source, self._sink = streams
        self._decode = decode
        self._started = False
        # the reference client knows data as buffer; an unknown kind does no harm
        kinds = "".join(kind + ";" for image in images for kind in ((image, "buffer") if image == "data" else (image,)))
        hello = {"trax.version": str(VERSION), "trax.name": name, "trax.image": kinds}
        hello.update({"trax.region": "rectangle;", "trax.channels": "color;"})
        hello.update(describe or {})
        self._send("hello", [], hello)

    def run(
        self,
        init: Callable[[Any, Box], Tuple[Any, Properties]],
        update: Callable[[Any], Tuple[Any, Properties]],
    ) -> None:
        """Answer the client until it ends the conversation.

        Args:
            init: starts on a target in an image and a box; returns the box and what is known of it.
            update: finds the target in the next image.

        Raises:
            ProtocolError: the client broke the protocol; it was sent a quit that says how.
        """
        try:
            self._answer(init, update)
        except ProtocolError as error:
            self._send("quit", [], {"trax.reason": str(error)})
            raise
        except (BrokenPipeError, ConnectionError):
            # nobody is left to answer
            return

    def fail(self, reason: str) -> None:
        """Send the client a quit with a reason: the tracker cannot go on."""
        try:
            self._send("quit", [], {"trax.reason": reason})
        except OSError:
            return

    def _answer(self, init: Callable[..., Any], update: Callable[..., Any]) -> None:
        region: Optional[str] = None
        for line in iter(self._source.readline, b""):
            message = split_message(line)
            if message is None:
                continue
            if message.kind == "quit":
                return
            if message.kind == "initialize":
                region = self._region(message, region)
                # versions 1 to 3 send the image and the region in one message
                if len(message.arguments) == 2:
                    self._report(*self._begin(init, message.arguments[0], region))
                    region = None
            elif message.kind == "frame":
                if len(message.arguments) != 1:
                    raise ProtocolError(f"frame has {len(message.arguments)} images: one is needed")
                if region is not None:
                    self._report(*self._begin(init, message.arguments[0], region))
                    region = None
                elif self._started:
                    self._report(*update(self._decode(message.arguments[0])))
                else:
                    raise ProtocolError("frame before initialize: there is no target yet")
            else:
                raise ProtocolError(f"message {message.kind!r:.20} is not one for a tracker")

    def _region(self, message: Message, waiting: Optional[str]) -> Optional[str]:
        """Return the region that waits for its image after an initialize message."""
        if not message.arguments:
            # all targets are dropped
            self._started = False
            return None
        if len(message.arguments) > 2:
            raise ProtocolError(f"initialize has {len(message.arguments)} arguments")
        if waiting is not None:
            raise ProtocolError("initialize with a second target: this tracker follows one")
        return message.arguments[-1]

    def _begin(self, init: Callable[..., Any], image: str, region: Optional[str]) -> Tuple[Any, Properties]:
        box = read_region(region or "")
        if box is None:
            raise ProtocolError(f"region {region!r} is no place to start from")
        answer: Tuple[Any, Properties] = init(self._decode(image), box)
        self._started = True
        return answer

    def _report(self, box: Any, properties: Properties) -> None:
        self._send("state", [write_rectangle(box)], properties)

    def _send(self, kind: str, arguments: List[str], properties: Properties) -> None:
        line = memoryview(join_message(kind, arguments, properties))
        # an unbuffered stream may take a part
        while line:
            line = line[self._sink.write(line) :]
