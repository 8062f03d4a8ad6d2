"""Reading and tracking in threads of their own: whoever watches or commands never holds them up."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image
from psiamfcpp.trackers import TargetPool, Track
from psiamfcpp.video.source import Source

MAX_TARGETS = 8
_MAX_WAITING = 16
_REOPEN_S = 1.0
T = TypeVar("T")


@dataclass(frozen=True)
class Shot:
    """A frame with what was found in it."""

    number: int
    """how many frames were looked at, this one included"""
    image: Image
    """``(H, W, 3)`` uint8, BGR; never written to"""
    read_at: float
    """when the source gave the frame, by `time.perf_counter`"""
    tracks: Mapping[int, Track]
    """by the target's number"""
    selected: int | None
    """the target that MAVLink speaks of"""
    tracker_s: float
    """what tracking took"""


@dataclass(frozen=True)
class Event:
    """Something that happened, in a line."""

    number: int
    """from 1, in order"""
    time: float
    """seconds since 1970"""
    text: str


class BusyError(UserError):
    """Not now: there is no frame yet, or too much is waiting. The same call may succeed later."""


class Follower:
    """Reads a source, follows targets in its newest frames, and takes commands from any thread.

    A file is played at its own rate, as a camera would be, and from its start again when it is over; then its
    targets are let go. Frames for which tracking leaves no time are skipped. A source that breaks off is opened
    again for as long as it takes, and targets are kept.
    """

    def __init__(self, open_source: Callable[[Callable[[str], None]], Source], pool: TargetPool):
        """Open the source; nothing runs yet.

        Args:
            open_source: opens the source anew, given where its events go.
            pool: what follows; without targets yet.

        Raises:
            UserError: the source cannot be opened.
        """
        self._open, self._pool = open_source, pool
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._incoming: tuple[Image, float] | None = None
        self._commands: deque[Callable[[], None]] = deque()
        self._tracks: dict[int, Track] = {}
        self._selected: int | None = None
        self._events: deque[Event] = deque(maxlen=200)
        self._event_count = 0
        self._intervals: deque[float] = deque(maxlen=30)
        self.newest: Shot | None = None
        self.read_at: float | None = None
        """when the source gave its last frame, by `time.perf_counter`, looked at or not"""
        self.failure: BaseException | None = None
        self.listeners: list[Callable[[], None]] = []
        """called after every frame, command and event, in the thread where it happened; must return at once"""
        self._source = open_source(self.tell)
        self.name, self.source_fps = self._source.name, self._source.fps
        self._threads = [
            threading.Thread(target=self._guarded, args=(run,), name=name, daemon=True)
            for run, name in ((self._read, "reader"), (self._follow, "tracker"))
        ]

    def __enter__(self) -> Follower:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        if self._source.live:
            # its reader waits for frames that may never come
            self._source.close()
        for thread in self._threads:
            thread.join()
        self._source.close()

    @property
    def fps(self) -> float:
        """Frames that were looked at in a second, of late."""
        intervals = list(self._intervals)
        return len(intervals) / sum(intervals) if intervals and sum(intervals) > 0 else 0.0

    def add(self, box: Box, image: Image | None = None) -> tuple[int, Track]:
        """Follow one more target and choose it.

        Args:
            box: ``(x, y, w, h)``, pixels, 0-based.
            image: the frame that the box belongs to; by default the newest.

        Returns:
            The target's number, and its first track.

        Raises:
            UserError: the box is not one that can be tracked in the frame.
            BusyError: there is no frame yet, or as many targets as can be followed.
        """

        def work() -> tuple[int, Track]:
            frame = image if image is not None else self._frame()
            if len(self._tracks) >= MAX_TARGETS:
                raise BusyError(f"{MAX_TARGETS} targets are followed already: stop one first")
            number, track = self._pool.add(frame, box)
            self._tracks[number], self._selected = track, number
            self.tell(f"target {number} is followed")
            return number, track

        return self._in_tracker(work)

    def remove(self, number: int) -> None:
        """Let a target go.

        Raises:
            UserError: there is none of that number.
        """

        def work() -> None:
            self._known(number)
            self._drop(number)
            self.tell(f"target {number} was stopped")

        self._in_tracker(work)

    def clear(self) -> None:
        """Let all targets go."""

        def work() -> None:
            if self._tracks:
                self._drop(*self._tracks)
                self.tell("all targets were stopped")

        self._in_tracker(work)

    def select(self, number: int) -> None:
        """Choose the target that MAVLink speaks of.

        Raises:
            UserError: there is none of that number.
        """

        def work() -> None:
            self._known(number)
            self._selected = number

        self._in_tracker(work)

    def tell(self, text: str) -> None:
        """Add an event."""
        with self._changed:
            self._event_count += 1
            self._events.append(Event(self._event_count, time.time(), text))
        self._notify()

    def events(self, after: int = 0) -> list[Event]:
        """The last 200 events, of those with a number above ``after``."""
        with self._changed:
            return [event for event in self._events if event.number > after]

    def _frame(self) -> Image:
        if self.newest is None:
            raise BusyError("no frame has come yet: try again")
        return self.newest.image

    def _known(self, number: int) -> None:
        if number not in self._tracks:
            raise UserError(f"there is no target {number}: {sorted(self._tracks) or 'none'} are followed")

    def _drop(self, *numbers: int) -> None:
        for number in numbers:
            self._pool.remove(number)
            self._tracks.pop(number, None)
        if self._selected not in self._tracks:
            self._selected = next(reversed(self._tracks), None)

    def _in_tracker(self, work: Callable[[], T]) -> T:
        """Run in the tracker's thread, between two frames, and wait for what comes of it."""
        future: Future[T] = Future()

        def run() -> None:
            try:
                future.set_result(work())
            except BaseException as error:  # belongs to the one who asked
                future.set_exception(error)

        with self._changed:
            if self._stop.is_set() or self.failure is not None:
                raise BusyError("shutting down")
            if len(self._commands) >= _MAX_WAITING:
                raise BusyError("too many commands are waiting: try again")
            self._commands.append(run)
            self._changed.notify_all()
        try:
            return future.result(timeout=10)
        except TimeoutError:
            raise BusyError("the tracker did not answer in time: try again") from None

    def _follow(self) -> None:
        last_at = 0.0
        while not self._stop.is_set():
            with self._changed:
                while not (self._incoming or self._commands or self._stop.is_set()):
                    self._changed.wait()
                incoming, self._incoming = self._incoming, None
                commands = list(self._commands)
                self._commands.clear()
            for command in commands:
                command()
            if incoming is not None:
                image, read_at = incoming
                start = time.perf_counter()
                self._update(image)
                now = time.perf_counter()
                self._publish(image, read_at, now - start, new=True)
                if last_at:
                    self._intervals.append(now - last_at)
                last_at = now
            elif self.newest is not None:
                self._publish(self.newest.image, self.newest.read_at, self.newest.tracker_s, new=False)

    def _update(self, image: Image) -> None:
        before, self._tracks = self._tracks, self._pool.update(image)
        for number, track in self._tracks.items():
            was = before[number].state
            if track.state != was and "lost" in (track.state, was):
                self.tell(f"target {number} was lost" if track.state == "lost" else f"target {number} was found again")

    def _publish(self, image: Image, read_at: float, tracker_s: float, new: bool) -> None:
        number = (self.newest.number if self.newest else 0) + new
        self.newest = Shot(number, image, read_at, dict(self._tracks), self._selected, tracker_s)
        self._notify()

    def _notify(self) -> None:
        for listener in list(self.listeners):
            listener()

    def _read(self) -> None:
        """Frames to the tracker, newest first, from a source that is opened again whenever it ends."""
        source = self._source
        while not self._stop.is_set():
            reason = self._play(source)
            if self._stop.is_set():
                return
            source.close()
            source = self._reopen(reason)

    def _play(self, source: Source) -> str:
        """Hand on the frames of a source until they end; why they did, if it was not their end."""
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
                self.read_at = time.perf_counter()
                with self._changed:
                    self._incoming = (image, self.read_at)
                    self._changed.notify_all()
                if self._stop.is_set():
                    return ""
        except UserError as error:
            return str(error)
        return ""

    def _reopen(self, reason: str) -> Source:
        if reason:
            self.tell(reason)
        while True:
            try:
                # not at full speed, should it end as soon as it begins
                self._stop.wait(_REOPEN_S if reason else 0.02)
                self._source = self._open(self.tell)
            except UserError as error:
                if str(error) != reason:
                    self.tell(str(error))
                reason = str(error)
                if not self._stop.is_set():
                    continue
                return self._source
            if not self._source.live:
                self.clear()
                self.tell(f"{self.name} starts again")
            return self._source

    def _guarded(self, run: Callable[[], None]) -> None:
        try:
            run()
        except BaseException as error:  # the server must end and say why, whatever it is
            if not self._stop.is_set():
                self.failure = error
                self._notify()


def bearing(track: Track, image: Image, fov: float) -> tuple[float, float]:
    """Direction of a target from the camera's axis, for a lens without distortion.

    Args:
        track: the target.
        image: the frame ``(H, W, 3)``.
        fov: horizontal field of view, degrees.

    Returns:
        Azimuth (right is positive) and elevation (up is positive), degrees, in the camera's own frame.
    """
    x, y, w, h = track.box
    height, width = image.shape[:2]
    focal = width / 2 / math.tan(math.radians(fov) / 2)
    right, down = x + (w - 1) / 2 - (width - 1) / 2, y + (h - 1) / 2 - (height - 1) / 2
    azimuth, elevation = math.atan2(right, focal), math.atan2(-down, float(np.hypot(right, focal)))
    return math.degrees(azimuth), math.degrees(elevation)
