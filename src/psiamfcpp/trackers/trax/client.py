"""`trax:COMMAND`: any program that speaks the TraX protocol, as a tracker like the others."""

from __future__ import annotations

import contextlib
import hashlib
import math
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image, check_box
from psiamfcpp.trackers.adapters.trax_worker import (
    Message,
    ProtocolError,
    join_message,
    read_region,
    write_rectangle,
)
from psiamfcpp.trackers.contract import STATES, Track
from psiamfcpp.trackers.trax.images import ImageSender
from psiamfcpp.trackers.trax.worker import Worker

FRAME_SECONDS = 60.0
"""how long a worker may take for one frame"""
START_SECONDS = 300.0
"""how long a worker may take to load its model and say hello"""
_LONGEST_LABEL = 160
# Since version 4 the region and the image of a new target travel in two messages.
_SEPARATE_SINCE = 4


def open_trax(
    command: str,
    *,
    name: str | None = None,
    threads: int | None = None,
    frame_seconds: float = FRAME_SECONDS,
    start_seconds: float = START_SECONDS,
) -> TraxTracker:
    """Start a TraX worker.

    Args:
        command: program and arguments, quoted as for a shell.
        name: short name of the tracker; by default see `trax_name`.
        threads: threads that the worker is asked to use (``OMP_NUM_THREADS`` and its like).
        frame_seconds: time-out of one frame, its transfer included.
        start_seconds: time-out of the start, until the worker says hello.

    Raises:
        UserError: the command cannot be read or started, or what it starts does not speak TraX.
    """
    words = _words(command)
    libraries = ("OMP", "MKL", "OPENBLAS", "NUMEXPR")
    environment = {} if threads is None else {f"{library}_NUM_THREADS": str(threads) for library in libraries}
    return TraxTracker(
        words,
        name or trax_name(command),
        identity(command, {}),
        label=_shortened(f"trax:{command}"),
        environment=environment,
        frame_seconds=frame_seconds,
        start_seconds=start_seconds,
    )


def open_tracker(name: str, options: Mapping[str, str]) -> TraxTracker:
    """Open ``trax:COMMAND``; the only option is ``threads``."""
    return open_trax(name, threads=int(options["threads"]) if "threads" in options else None)


def identity(name: str, options: Mapping[str, str]) -> dict[str, Any]:
    """Return the identity of ``trax:COMMAND`` without starting it: of files that it names, the content.

    Raises:
        UserError: the command cannot be read.
    """
    return {"kind": "trax", "command": [_nameless(word) for word in _words(name)]}


def trax_name(command: str) -> str:
    """Return the short name of a worker: the stem of the first file among its arguments, or of the program.

    Raises:
        UserError: the command cannot be read.
    """
    words = _words(command)
    return Path(next(map(str, trax_files(command)[:1]), words[0])).stem


def trax_files(command: str) -> list[Path]:
    """Return the files that a command names beside its program: their content is part of the tracker's identity.

    Raises:
        UserError: the command cannot be read.
    """
    return [Path(word) for word in _words(command)[1:] if _is_file(word)]


class TraxTracker:
    """See `psiamfcpp.trackers.contract.Tracker`; the tracker runs in a process of its own.

    The score is the worker's property ``confidence``, the state its property ``state``, where it sends them. A
    special region (one number) stands for "nowhere": the box stays, and the state is lost.

    A fault of the worker ends it, and the next `init` starts another.

    Args:
        command: program and arguments.
        name: short name.
        identity: see the contract.
        label: what the user called the tracker, for errors.
        environment: variables beside those of this process.
        frame_seconds: time-out of one frame.
        start_seconds: time-out of the start.
        reuse: give one worker all targets. Many programs in the wild handle one target alone, so that by default
            each target gets a worker of its own.
    """

    def __init__(
        self,
        command: list[str],
        name: str,
        identity: Mapping[str, Any],
        *,
        label: str,
        environment: Mapping[str, str],
        frame_seconds: float = FRAME_SECONDS,
        start_seconds: float = START_SECONDS,
        reuse: bool = False,
    ):
        if shutil.which(command[0]) is None:
            raise UserError(f"tracker {label!r} cannot be started: there is no program {command[0]!r}")
        self._command, self._name, self._identity = command, name, dict(identity)
        self._label, self._environment = label, environment
        self._frame_seconds, self._start_seconds, self._reuse = frame_seconds, start_seconds, reuse
        self._worker: Worker | None = None
        # frames that this worker has seen of its target
        self._count = 0
        self._start()

    @property
    def name(self) -> str:
        """Short name, as tables and result folders show it."""
        return self._name

    @property
    def identity(self) -> Mapping[str, Any]:
        """Kind and command; of files that the command names, the content instead of the folder."""
        return self._identity

    def init(self, frame: Image, box: ArrayLike) -> Track:
        """Start to follow a target in a frame ``(H, W, 3)`` uint8, BGR; see the contract."""
        if self._worker is None or (self._count and not self._reuse):
            self.close()
            self._start()
        image = self._sender.text(frame)
        region = self._region(check_box(box, frame.shape))
        if self._version < _SEPARATE_SINCE:
            lines = join_message("initialize", [image, region])
        else:
            # an empty one drops the target before
            lines = join_message("initialize") if self._count else b""
            lines += join_message("initialize", [region]) + join_message("frame", [image])
        self._count = 1
        self._box = check_box(box, frame.shape)
        return self._track(self._exchange(lines))

    def update(self, frame: Image) -> Track:
        """Find the target in the next frame ``(H, W, 3)`` uint8, BGR; see the contract."""
        if self._worker is None or not self._count:
            raise UserError(f"tracker {self._label!r} has no target: call init() first")
        image = self._sender.text(frame)
        self._count += 1
        return self._track(self._exchange(join_message("frame", [image])))

    def close(self) -> None:
        """End the worker and everything that it started; may be called twice."""
        if self._worker is not None:
            self._worker.close(join_message("quit"))
            self._worker = None

    def _start(self) -> None:
        worker = Worker(self._command, self._label, self._environment)
        try:
            hello = worker.exchange(b"", "hello", self._start_seconds, "at its start")
            try:
                self._version = int(hello.properties.get("trax.version", "1"))
                self._sender = ImageSender(_listed(hello, "trax.image"), worker.folder)
                regions = _listed(hello, "trax.region") or ["rectangle"]
                self._region = next((_REGIONS[kind] for kind in _REGIONS if kind in regions), None) or _refuse(regions)
                channels = _listed(hello, "trax.channels") or ["color"]
                if channels != ["color"]:
                    raise ProtocolError(f"it needs the image channels {', '.join(channels)}: there is color alone")
            except ValueError:
                worker.fail("says hello with a version that is no number")
            except ProtocolError as error:
                worker.fail(f"cannot be used: {error}")
        except BaseException:
            worker.close()
            raise
        self._worker, self._count = worker, 0

    def _exchange(self, lines: bytes) -> Message:
        worker, self._worker = self._worker, None
        assert worker is not None
        try:
            answer = worker.exchange(lines, "state", self._frame_seconds, f"in frame {self._count}")
        except BaseException:
            # an interruption leaves an answer behind that would be taken for another frame's
            worker.close()
            raise
        self._worker = worker
        return answer

    def _track(self, state: Message) -> Track:
        assert self._worker is not None
        worker, where = self._worker, f"in frame {self._count}"
        try:
            if len(state.arguments) != 1:
                raise ProtocolError(f"{len(state.arguments)} regions where one is due")
            box = read_region(state.arguments[0])
        except ProtocolError as error:
            self._worker = None
            worker.fail(f"answered nonsense {where}: {error}")
        if box is None:
            return Track(self._box, state="lost")
        self._box = box
        known = state.properties.get("state")
        return Track(box, _score(state), next((name for name in STATES if name == known), None))


def _words(command: str) -> list[str]:
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise UserError(f"command {command!r} of a TraX tracker cannot be read ({error}): check its quotes") from None
    if not words:
        raise UserError("a TraX tracker needs a command: give trax:COMMAND")
    return words


def _shortened(label: str) -> str:
    """Return a label of one line, of which the end is left out if it is long."""
    line = " ".join(label.split())
    return line if len(line) <= _LONGEST_LABEL else line[:_LONGEST_LABEL] + "..."


def _is_file(word: str) -> bool:
    # a program given on the command line is too long for a name, or holds what no name can
    with contextlib.suppress(OSError, ValueError):
        return Path(word).is_file()
    return False


def _nameless(word: str) -> str:
    """Return a word of a command without the folder that a file lies in, but with the file's checksum."""
    path = Path(word)
    if not _is_file(word):
        return word
    # an interpreter is a file as well, and differs between machines
    if shutil.which(word) is not None:
        return path.name
    return f"{path.name}:{hashlib.sha256(path.read_bytes()).hexdigest()[:16]}"


def _listed(hello: Message, key: str) -> list[str]:
    return [part for part in hello.properties.get(key, "").replace(",", ";").split(";") if part]


def _score(state: Message) -> float | None:
    try:
        score = float(state.properties["confidence"])
    except (KeyError, ValueError):
        return None
    return score if math.isfinite(score) else None


def _polygon(box: Box) -> str:
    x, y, w, h = box
    return ",".join(repr(float(v)) for v in (x, y, x + w, y, x + w, y + h, x, y + h))


def _mask(box: Box) -> str:
    x, y, w, h = (round(value) for value in box)
    return f"mask:{x},{y},{max(w, 1)},{max(h, 1)},0,{max(w, 1) * max(h, 1)}"


def _refuse(regions: list[str]) -> Any:
    raise ProtocolError(f"it needs regions as {', '.join(regions)}: known are {', '.join(_REGIONS)}")


_REGIONS = {"rectangle": write_rectangle, "polygon": _polygon, "mask": _mask}
