"""Reads a source in a thread: at the source's own rate, and opened again whenever it ends."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.video.source import Source

_REOPEN_S = 1.0
# The end of a file is not a fault, but a file that ends as soon as it begins must not be reopened at full speed.
_REPLAY_S = 0.02


class Reader:
    """Hands the frames of a source to a callback, and never waits for whoever uses them.

    A file is played at its own rate, as a camera would be, and from its start again at its end; it can be paused, and
    played from another frame. A source that breaks off is reopened for as long as it takes.
    """

    def __init__(
        self,
        open_source: Callable[[Callable[[str], None]], Source],
        give: Callable[[Image, float], None],
        jumped: Callable[[bool], None],
        tell: Callable[[str], None],
    ):
        """Open the source; nothing is read yet.

        Args:
            open_source: opens the source anew, given where its events go.
            give: receives each frame ``(H, W, 3)`` uint8 BGR, read-only, and when it was read (`time.perf_counter`).
            jumped: called before a frame that does not follow the one before; whether the file starts again.
            tell: receives events, one line each.

        Raises:
            UserError: the source cannot be opened.
        """
        self._open, self._give, self._jumped = open_source, give, jumped
        self._stop = threading.Event()
        # set by whatever must not wait for the next frame's time
        self._asked = threading.Event()
        self._target: int | None = None
        self._paused = False
        self._say = tell
        self._given = self.name = ""
        self._source = open_source(self._tell)
        self._given, self.name = self._source.name, short_name(self._source)
        self.fps, self.live, self.frame_count = self._source.fps, self._source.live, self._source.frame_count
        self.position = 0
        """number of the frame that was read last, in a file or folder"""

    @property
    def paused(self) -> bool:
        """Whether it was paused."""
        return self._paused

    def run(self) -> None:
        """Read until `stop` is called."""
        source = self._source
        while not self._stop.is_set():
            reason = self._play(source)
            if self._stop.is_set():
                return
            source.close()
            source = self._reopen(reason)

    def pause(self, on: bool) -> None:
        """Stop before the next frame of a file, or go on; from any thread.

        Raises:
            UserError: the source is live.
        """
        self._refuse_live("paused")
        self._paused = on
        self._asked.set()

    def seek(self, number: int) -> None:
        """Play a file from another frame on, and show that frame while paused; from any thread.

        Raises:
            UserError: the source is live.
        """
        self._refuse_live("wound")
        self._target = number if self.frame_count is None else min(number, self.frame_count - 1)
        self._asked.set()

    def stop(self) -> None:
        """End `run`, from another thread."""
        self._stop.set()
        self._asked.set()
        if self._source.live:
            # its reader waits for frames that may never come
            self._source.close()

    def close(self) -> None:
        """Close the source, after `run` has ended."""
        self._source.close()

    def _tell(self, text: str) -> None:
        # clients may get no path of this machine, and messages of sources name them as they were given
        self._say(text.replace(self._given, self.name) if self._given else text)

    def _refuse_live(self, what: str) -> None:
        if self.live:
            raise UserError(f"{self.name} is live: only files and folders can be {what}")

    def _play(self, source: Source) -> str:
        """Hand on the frames of a source until they end; the reason, if it was not their end."""
        pace = _Pace(source.fps)
        self.position = -1
        try:
            while not self._stop.is_set():
                if not source.live and not self._ready(source, pace):
                    continue
                image = next(source, None)
                if image is None:
                    return ""
                if not source.live:
                    self._asked.wait(pace.left())
                    if self._target is not None or self._stop.is_set():
                        continue
                self.position += 1
                image.flags.writeable = False
                self._give(image, time.perf_counter())
        except UserError as error:
            return str(error)
        return ""

    def _ready(self, source: Source, pace: _Pace) -> bool:
        """Do what was asked of a file: go to another frame, or wait; whether its next frame is wanted now."""
        self._asked.clear()
        target, self._target = self._target, None
        if target is not None:
            source.seek(target)
            self.position = target - 1
            self._jumped(False)
            pace.restart()
        elif self._paused:
            self._asked.wait()
            pace.restart()
            return False
        return True

    def _reopen(self, reason: str) -> Source:
        if reason:
            self._tell(reason)
        while True:
            try:
                self._stop.wait(_REOPEN_S if reason else _REPLAY_S)
                self._source = self._open(self._tell)
            except UserError as error:
                if str(error) != reason:
                    self._tell(str(error))
                reason = str(error)
                if not self._stop.is_set():
                    continue
                return self._source
            if not self._source.live:
                self._jumped(True)
            return self._source


class _Pace:
    """When the frames of a file are due."""

    def __init__(self, fps: float):
        self._fps = fps
        self.restart()

    def restart(self) -> None:
        """The next frame is due now."""
        self._start, self._count = time.perf_counter(), 0

    def left(self) -> float:
        """Seconds until the next frame is due."""
        now = time.perf_counter()
        due = self._start + self._count / self._fps
        if now - due > 1:
            # reading is slower than the file's own rate: there is nothing to catch up with
            self.restart()
        self._count += 1
        return max(0.0, due - now)


def short_name(source: Source) -> str:
    """Return what clients see of a source: the name of a file or folder without its path."""
    return source.name if source.live else Path(source.name).name or Path(source.name).resolve().name
