"""A TraX server in one file, for trackers that live in an interpreter of their own.

It needs Python 3.6 and NumPy and imports nothing else of this package, so that an adapter can run it in the
environment of the tracker. The protocol is TraX, version 4 (https://trax.readthedocs.io, "TraX protocol
specification"): one message per line on standard input and output, prefixed with ``@@TRAX:``.

What the tracker prints goes to standard error: `claim_streams` gives standard output to the protocol alone.
"""

import argparse
import base64
import collections.abc
import importlib.util
import os
import random
import re
import socket
import sys
import types
from pathlib import Path
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


class Setup(NamedTuple):
    """What an adapter builds its tracker from."""

    checkout: str
    """folder of the tracker's repository; it is on ``sys.path``"""
    weights: str
    """weights file, or an empty string for random weights"""
    device: str
    """cpu or cuda"""
    options: Dict[str, str]
    """anything else that the user gave"""


def seed_everything(threads: int, seed: int = 0) -> None:
    """Set the seeds of Python, NumPy and torch, and the threads of torch, where it is imported already."""
    random.seed(seed)
    np.random.seed(seed)
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.manual_seed(seed)
        torch.set_num_threads(threads)


def adapt_torch(device: str) -> None:
    """Let research code of its time run with the torch of today, and on the CPU where that is asked for.

    * Weights files are pickles of the authors; since torch 2.6 `torch.load` refuses them by itself.
    * ``torchvision.models.resnet.model_urls`` is gone since torchvision 0.13; only pre-training used it.
    * ``torch._six`` is gone since torch 1.13.
    * Nothing is fetched: weights come from the user's file.
    * Without a GPU, ``.cuda()`` and ``.to("cuda")`` stay on the CPU.
    """
    import torch
    import torch.utils.model_zoo

    load = torch.load

    def load_file(*args: Any, **kwargs: Any) -> Any:
        if "weights_only" in load.__code__.co_varnames:
            kwargs.setdefault("weights_only", False)
        if device == "cpu":
            kwargs["map_location"] = "cpu"
        return load(*args[:1], **kwargs)

    def refuse(url: str, *args: Any, **kwargs: Any) -> Any:
        raise RuntimeError(f"the tracker wants to fetch {url}: give it a weights file")

    torch.load = load_file
    torch.hub.load_state_dict_from_url = refuse
    torch.utils.model_zoo.load_url = refuse
    try:
        import torchvision.models.resnet as resnet
    except ImportError:
        resnet = None
    if resnet is not None and not hasattr(resnet, "model_urls"):
        resnet.model_urls = dict.fromkeys(("resnet18", "resnet34", "resnet50", "resnet101", "resnet152"), "weights")
    if importlib.util.find_spec("torch._six") is None:
        six = types.ModuleType("torch._six")
        six.container_abcs, six.string_classes, six.int_classes = collections.abc, (str, bytes), int
        sys.modules["torch._six"] = six
    if device == "cpu":
        _stay_on_cpu(torch)


def _stay_on_cpu(torch: Any) -> None:
    def here(self: Any, *args: Any, **kwargs: Any) -> Any:
        return self

    def elsewhere(place: Any) -> Any:
        named = isinstance(place, (str, torch.device)) and str(place).startswith("cuda")
        return "cpu" if named else place

    def staying(move: Any) -> Any:
        def to(self: Any, *args: Any, **kwargs: Any) -> Any:
            return move(self, *map(elsewhere, args), **{key: elsewhere(value) for key, value in kwargs.items()})

        return to

    for kind in (torch.Tensor, torch.nn.Module):
        kind.cuda = here
        kind.to = staying(kind.to)
    torch.cuda.current_device = lambda: 0


class PysotStyle:
    """Trackers with ``init(image, box)`` and ``track(image)["bbox"]``, as in PySOT."""

    def __init__(self, tracker: Any) -> None:
        self._tracker = tracker

    def init(self, image: Any, box: List[float]) -> None:
        """Start on a box."""
        self._tracker.init(image, box)

    def update(self, image: Any) -> Any:
        """Return box and score of the next image."""
        found = self._tracker.track(image)
        return found["bbox"], found.get("best_score")


class PytrackingStyle:
    """Trackers with ``initialize(image, {"init_bbox": box})`` and ``track(image)["target_bbox"]``, as in PyTracking.

    Args:
        tracker: the tracker, or what makes a new one for each target.
        score: key of the score in what `track` returns; of several values the highest counts.
    """

    def __init__(self, tracker: Any, score: str = "") -> None:
        self._make = tracker if callable(tracker) else lambda: tracker
        self._score = score

    def init(self, image: Any, box: List[float]) -> None:
        """Start on a box."""
        self._tracker = self._make()
        self._tracker.initialize(image, {"init_bbox": box})

    def update(self, image: Any) -> Any:
        """Return box and score of the next image."""
        found = self._tracker.track(image)
        return found["target_bbox"], float(np.max(found[self._score])) if self._score else None


def box_and_score(answer: Any) -> Tuple[Any, Optional[float]]:
    """Return the box ``(4,)`` and the score, or None, of what a tracker's `update` returned.

    Raises:
        ValueError: it is neither a box of four finite numbers, nor a pair of a box and a score.
    """
    box, score = answer if isinstance(answer, tuple) and len(answer) == 2 else (answer, None)
    try:
        values = np.asarray(box, float).reshape(4)
    except (TypeError, ValueError):
        raise ValueError(f"update() returned {answer!r:.60}: a box x,y,w,h is needed") from None
    if not np.isfinite(values).all():
        raise ValueError(f"update() returned a box that is not finite: {values}")
    return values, None if score is None else float(score)


def main(facts: Dict[str, Any], build: Callable[[Setup], Any]) -> None:
    """Run an adapter: build the tracker, then serve it until the client ends the conversation.

    Args:
        facts: what the adapter says of its tracker; ``colour`` (rgb or bgr) and ``origin`` (0 or 1, where the
            tracker counts its pixels from) are applied here.
        build: makes the tracker: an object with ``init(image, box)`` and ``update(image)``, which returns a box
            ``(x, y, w, h)`` or a pair of box and score.
    """
    streams = claim_streams()
    # the adapters themselves are no modules for the tracker
    here = Path(__file__).resolve().parent
    sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != here]
    parser = argparse.ArgumentParser(description=facts["name"])
    parser.add_argument("--checkout", required=True)
    parser.add_argument("--weights", default="")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    args = parser.parse_args()
    checkout = str(Path(args.checkout).resolve())
    options = dict(pair.split("=", 1) for pair in args.set)
    setup = Setup(checkout, str(Path(args.weights).resolve()) if args.weights else "", args.device, options)
    sys.path.insert(0, checkout)
    # research code opens its configurations by relative paths
    os.chdir(checkout)
    os.environ.setdefault("OMP_NUM_THREADS", str(args.threads))
    if args.device == "cpu":
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    if "torch" in facts["modules"]:
        adapt_torch(args.device)
    seed_everything(args.threads)
    tracker = build(setup)
    session = Session(streams, facts["name"])
    origin = np.array([facts["origin"], facts["origin"], 0, 0], float)

    def colours(image: Any) -> Any:
        return np.ascontiguousarray(image if facts["colour"] == "rgb" else image[:, :, ::-1])

    def init(image: Any, box: Box) -> Tuple[Any, Properties]:
        # one worker follows many targets: each has the seeds of the first
        seed_everything(args.threads)
        tracker.init(colours(image), [float(value) for value in np.array(box) + origin])
        return box, {}

    def update(image: Any) -> Tuple[Any, Properties]:
        box, score = box_and_score(tracker.update(colours(image)))
        return box - origin, {} if score is None else {"confidence": repr(score)}

    try:
        session.run(init, update)
    except ProtocolError:
        raise
    except Exception as error:
        session.fail(f"{type(error).__name__}: {error}")
        raise
