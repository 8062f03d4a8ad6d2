"""A worker process and the messages to and from it, none of which can make us wait for ever."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

from psiamfcpp.errors import UserError
from psiamfcpp.trackers.adapters.trax_worker import Message, ProtocolError, split_message

# A state with a mask of a large image stays below this.
_LONGEST_LINE = 8 << 20
_BLOCK = 1 << 16
_PIPE = 1 << 20
_LAST_LINES, _LAST_CHARACTERS = 3, 300
_GOODBYE_SECONDS = 10.0


class Worker:
    """A tracker's process, which speaks TraX over its standard input and output.

    Every fault of the worker ends it and raises a `UserError` of one line that names it, says what happened, and
    ends with the last lines that it printed.

    Args:
        command: program and arguments.
        label: what the user calls it.
        environment: variables beside those of this process.
    """

    def __init__(self, command: list[str], label: str, environment: Mapping[str, str]):
        self._control = -1
        self.label = label
        self.folder = Path(tempfile.mkdtemp(prefix="psiamfcpp-trax-"))
        self._said: deque[str] = deque(maxlen=_LAST_LINES)
        self._complaints, self._received, self._outgoing = bytearray(), bytearray(), b""
        self._searched = 0
        guarded, self._control = os.pipe()
        guard = [sys.executable, "-I", "-S", str(Path(__file__).with_name("guard.py")), str(guarded), str(self.folder)]
        pipe = subprocess.PIPE
        try:
            self._process = subprocess.Popen(
                guard + command, stdin=pipe, stdout=pipe, stderr=pipe, bufsize=0, pass_fds=(guarded,),
                start_new_session=True, env={**os.environ, **environment},
            )  # fmt: skip
        except OSError:
            os.close(self._control)
            self._control = -1
            self.folder.rmdir()
            raise
        finally:
            os.close(guarded)
        streams = (self._process.stdin, self._process.stdout, self._process.stderr)
        self._stdin, self._stdout, self._stderr = (stream.fileno() for stream in streams if stream is not None)
        for descriptor in (self._stdin, self._stdout, self._stderr):
            os.set_blocking(descriptor, False)
        # A frame of megabytes through a pipe of 64 KiB is many switches between two processes.
        with contextlib.suppress(AttributeError, OSError):
            fcntl.fcntl(self._stdin, fcntl.F_SETPIPE_SZ, _PIPE)
        self._poll = select.poll()
        self._poll.register(self._stdout, select.POLLIN)
        self._poll.register(self._stderr, select.POLLIN)

    def __del__(self) -> None:
        self.close()

    def exchange(self, lines: bytes, kind: str, seconds: float, doing: str) -> Message:
        """Send lines and return the one message of a kind that answers them.

        Args:
            lines: what to send; may be empty.
            kind: hello or state.
            seconds: how long sending and waiting may take together.
            doing: for the error, such as ``in frame 3``.

        Raises:
            UserError: the worker ended, hung, or answered anything else.
        """
        end = time.monotonic() + seconds
        if lines:
            self._nothing_pending(doing)
            self._outgoing = lines
            self._poll.register(self._stdin, select.POLLOUT)
        while True:
            message = self._next(doing)
            if message is None:
                left = end - time.monotonic()
                if left <= 0:
                    self.fail(f"gave no answer {doing} in {seconds:g} s")
                self._wait(left, doing)
            elif message.kind == kind:
                return message
            elif message.kind == "quit":
                reason = message.properties.get("trax.reason")
                self.fail(f"quit {doing}" + (f" ({' '.join(reason.split())[:_LAST_CHARACTERS]})" if reason else ""))
            else:
                self.fail(f"sent {message.kind!r:.20} {doing} where {kind} was due")

    def fail(self, what: str) -> NoReturn:
        """End the worker and raise the error that says what it did."""
        # what it wrote last may still be in the pipe
        with contextlib.suppress(OSError):
            self._complain(os.read(self._stderr, _BLOCK))
        self.close()
        if self._complaints:
            self._said.append(self._complaints.decode(errors="replace"))
        last = " | ".join(text for line in self._said if (text := " ".join(line.split())))
        ending = f"; it printed last: {last[-_LAST_CHARACTERS:]}" if last else ""
        raise UserError(f"tracker {self.label!r} {what}{ending}")

    def close(self, goodbye: bytes = b"") -> None:
        """End the worker and everything that it started; may be called twice.

        Args:
            goodbye: sent first; the worker is then given a moment to end by itself.
        """
        if self._control < 0:
            return
        if goodbye and not self._outgoing:
            with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                os.write(self._stdin, goodbye)
                self._process.wait(_GOODBYE_SECONDS)
        os.close(self._control)
        self._control = -1
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()

    def _nothing_pending(self, doing: str) -> None:
        """Refuse an answer before its question: later boxes would belong to other frames."""
        with contextlib.suppress(BlockingIOError):
            self._received += os.read(self._stdout, _BLOCK)
        message = self._next(doing)
        if message is not None and message.kind != "quit":
            self.fail(f"sent a second {message.kind} for one frame, before it was asked {doing}")

    def _next(self, doing: str) -> Message | None:
        """Return the next message among what was received; other lines are the tracker's own output."""
        while (end := self._received.find(b"\n", self._searched)) >= 0:
            line = bytes(self._received[: end + 1])
            del self._received[: end + 1]
            self._searched = 0
            try:
                message = split_message(line)
            except ProtocolError as error:
                self.fail(f"answered nonsense {doing}: {error}")
            if message is not None:
                return message
            self._said.append(line[:_LAST_CHARACTERS].decode(errors="replace"))
        self._searched = len(self._received)
        if self._searched > _LONGEST_LINE:
            self.fail(f"wrote a line of more than {_LONGEST_LINE >> 20} MiB {doing}")
        return None

    def _wait(self, seconds: float, doing: str) -> None:
        """Move bytes in whatever direction they can go, or wait for that."""
        for descriptor, _ in self._poll.poll(seconds * 1000):
            if descriptor == self._stdin:
                self._write()
                continue
            block = b""
            with contextlib.suppress(BlockingIOError):
                block = os.read(descriptor, _BLOCK)
            if descriptor == self._stderr:
                if not block:
                    self._poll.unregister(descriptor)
                self._complain(block)
            elif block:
                self._received += block
            else:
                self.fail(f"{self._ending()} {doing}")

    def _write(self) -> None:
        try:
            written = os.write(self._stdin, memoryview(self._outgoing)[:_PIPE])
        except BrokenPipeError:
            # its end shows on its output, with the reason
            written = len(self._outgoing)
        self._outgoing = self._outgoing[written:]
        if not self._outgoing:
            self._poll.unregister(self._stdin)

    def _complain(self, block: bytes) -> None:
        """Keep the last lines of standard error."""
        *lines, self._complaints = (self._complaints + block).split(b"\n")
        self._complaints = self._complaints[-_LAST_CHARACTERS:]
        self._said.extend(line[:_LAST_CHARACTERS].decode(errors="replace") for line in lines if line.strip())

    def _ending(self) -> str:
        """Say how a worker whose output has closed has ended."""
        try:
            status = self._process.wait(_GOODBYE_SECONDS)
        except subprocess.TimeoutExpired:
            return "closed its output"
        if status == 127:
            return "could not be started"
        if status > 128:
            with contextlib.suppress(ValueError):
                return f"was killed by {signal.Signals(status - 128).name}"
        return f"ended with exit code {status}"
