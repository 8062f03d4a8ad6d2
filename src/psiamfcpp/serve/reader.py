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

    A file is played at its own rate, as a camera would be, and from its start again at its end. A source that
    breaks off is reopened for as long as it takes.
    """

    def __init__(
        self,
        open_source: Callable[[Callable[[str], None]], Source],
        give: Callable[[Image, float], None],
        replayed: Callable[[], None],
        tell: Callable[[str], None],
    ):
        """Open the source; nothing is read yet.

        Args:
            open_source: opens the source anew, given where its events go.
            give: receives each frame ``(H, W, 3)`` uint8 BGR, read-only, and when it was read (`time.perf_counter`).
            replayed: called when a file starts again, before its first frame.
            tell: receives events, one line each.

        Raises:
            UserError: the source cannot be opened.
        """
        self._open, self._give, self._replayed, self._tell = open_source, give, replayed, tell
        self._stop = threading.Event()
        self._source = open_source(tell)
        self.name, self.fps = self._source.name, self._source.fps

    def run(self) -> None:
        """Read until `stop` is called."""
        source = self._source
        while not self._stop.is_set():
            reason = self._play(source)
            if self._stop.is_set():
                return
            source.close()
            source = self._reopen(reason)

    def stop(self) -> None:
        """End `run`, from another thread."""
        self._stop.set()
        if self._source.live:
            # its reader waits for frames that may never come
            self._source.close()

    def close(self) -> None:
        """Close the source, after `run` has ended."""
        self._source.close()

    def _play(self, source: Source) -> str:
        """Hand on the frames of a source until they end; the reason, if it was not their end."""
        start, count = time.perf_counter(), 0
        try:
            for image in source:
                now = time.perf_counter()
                if not source.live:
                    due = start + count / source.fps
                    if now - due > 1:
                        # reading is slower than the file's own rate: there is nothing to catch up with
                        start, count = now, 0
                    elif self._stop.wait(max(0.0, due - now)):
                        return ""
                count += 1
                image.flags.writeable = False
                self._give(image, time.perf_counter())
                if self._stop.is_set():
                    return ""
        except UserError as error:
            return str(error)
        return ""

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
                self._replayed()
                self._tell(f"{self.name} starts again")
            return self._source


def short_name(source: Source) -> str:
    """What clients are told of a source: the name of a file or folder without its path."""
    return source.name if source.live else Path(source.name).name or Path(source.name).resolve().name
