"""Tracking in a thread of its own: clients that watch or command never hold it up."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image
from psiamfcpp.serve.reader import Reader
from psiamfcpp.serve.ring import Ring, stepping_stones
from psiamfcpp.trackers import TargetPool, Track
from psiamfcpp.video.source import Source

MAX_TARGETS = 8
# Frames over which a target that was drawn on an older one catches up: a few tenths of a second of tracking.
_CATCH_UP = 24
_MAX_WAITING = 16
_ANSWER_S = 10.0
T = TypeVar("T")
# Done in the tracker's thread; what it returns answers whoever asked, once the newest shot shows what was done.
_Command = Callable[[], Callable[[], None] | None]


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


class FrameGoneError(UserError):
    """The frame that a box was drawn on is no longer kept."""


class Follower:
    """Reads a source, follows targets in its newest frames, and takes commands from any thread.

    A file is played at its own rate, as a camera would be, and from its start again when it is over; then its
    targets are released. It can be paused, and played from another frame. Frames for which tracking leaves no time are
    skipped. A source that breaks off is opened again for as long as it takes, and targets are kept.
    """

    def __init__(self, open_source: Callable[[Callable[[str], None]], Source], pool: TargetPool):
        """Open the source; nothing runs yet.

        Args:
            open_source: opens the source anew, given where its events go.
            pool: what follows; without targets yet.

        Raises:
            UserError: the source cannot be opened.
        """
        self._pool = pool
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._incoming: tuple[Image, float] | None = None
        self._commands: deque[_Command] = deque()
        self._tracks: dict[int, Track] = {}
        self._selected: int | None = None
        self._events: deque[Event] = deque(maxlen=200)
        self._event_count = 0
        self._intervals: deque[float] = deque(maxlen=30)
        self._last_at = 0.0
        self.started = 0
        """how many targets were started so far"""
        self.newest: Shot | None = None
        self.read_at: float | None = None
        """when the source gave its last frame, by `time.perf_counter`, looked at or not"""
        self.failure: BaseException | None = None
        self.listeners: list[Callable[[], None]] = []
        """called after every frame, command and event, in the thread where it happened; must return at once"""
        self.ring = Ring()
        """the last frames that were looked at, by the numbers of their shots"""
        self._reader = Reader(open_source, self._take, self._jumped, self.tell)
        self.name, self.source_fps = self._reader.name, self._reader.fps
        self.live, self.frame_count = self._reader.live, self._reader.frame_count
        self._threads = [
            threading.Thread(target=self._guarded, args=(run,), name=name, daemon=True)
            for run, name in ((self._reader.run, "reader"), (self._follow, "tracker"))
        ]

    def __enter__(self) -> Follower:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        self._reader.stop()
        for thread in self._threads:
            thread.join()
        self._reader.close()

    @property
    def fps(self) -> float:
        """Frames that were looked at in a second, of late."""
        intervals = list(self._intervals)
        return len(intervals) / sum(intervals) if intervals and sum(intervals) > 0 else 0.0

    @property
    def paused(self) -> bool:
        """Whether the file was paused."""
        return self._reader.paused

    @property
    def position(self) -> int:
        """Number of the frame of a file that was read last, from 0."""
        return max(0, self._reader.position)

    def pause(self, on: bool) -> None:
        """Stop playing a file, or go on; `UserError` where the source is live."""
        self._reader.pause(on)
        self._notify()

    def seek(self, number: int) -> None:
        """Play a file from another frame on, without the targets; `UserError` where the source is live."""
        self._reader.seek(number)

    def image(self, frame: int | None) -> Image:
        """Return the image of a shot's number ``(H, W, 3)`` BGR; without one, the newest.

        Raises:
            FrameGoneError: it is no longer kept.
            BusyError: no frame has come yet.
        """
        return self._frame() if frame is None else self._since(frame)[0][1]

    def add(
        self, box: Box, image: Image | None = None, frame: int | None = None, replace: int | None = None
    ) -> tuple[int, Track]:
        """Follow one more target and choose it.

        Args:
            box: ``(x, y, w, h)``, pixels, 0-based.
            image: the frame that the box belongs to; by default the newest.
            frame: number of the shot that the box belongs to, instead of ``image``: from there the target catches up
                with the newest frame, over at most some frames between.
            replace: a target that is stopped once this one is followed.

        Returns:
            The target's number, and its first track.

        Raises:
            UserError: the box is not one that can be tracked in the frame, or there is no target to replace.
            FrameGoneError: the frame is no longer kept.
            BusyError: there is no frame yet, or as many targets as can be followed.
        """

        def work() -> tuple[int, Track]:
            if replace is not None:
                self._known(replace)
            elif len(self._tracks) >= MAX_TARGETS:
                raise BusyError(f"{MAX_TARGETS} targets are followed already: stop one first")
            since = [] if frame is None else self._since(frame)
            start = since[0][1] if since else self._frame() if image is None else image
            number, track = self._pool.add(start, box)
            self._tracks[number] = self._caught_up(number, track, since[1:])
            if replace is not None:
                self._drop(replace)
            self._selected = number
            self.started += 1
            self.tell(f"target {number} is followed" + ("" if replace is None else f", target {replace} no more"))
            return number, track

        return self._in_tracker(work)

    def remove(self, number: int) -> None:
        """Stop a target.

        Raises:
            UserError: there is none of that number.
        """

        def work() -> None:
            self._known(number)
            self._drop(number)
            self.tell(f"target {number} was stopped")

        self._in_tracker(work)

    def clear(self) -> None:
        """Stop following all targets."""
        self._in_tracker(self._drop_all)

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

    def _since(self, frame: int) -> list[tuple[int, Image]]:
        """The frames from a shot's number to the newest."""
        found = self.ring.since(frame)
        if not found:
            raise FrameGoneError("the frame that this was drawn on is no longer kept: draw on the image as it is now")
        return found

    def _caught_up(self, number: int, track: Track, since: list[tuple[int, Image]]) -> Track:
        """The track of a target in the newest frame, given its first one and the frames since."""
        for image in stepping_stones(since, _CATCH_UP):
            track = self._pool.update_one(number, image)
        return track

    def _known(self, number: int) -> None:
        if number not in self._tracks:
            raise UserError(f"there is no target {number}: {sorted(self._tracks) or 'none'} are followed")

    def _drop(self, *numbers: int) -> None:
        for number in numbers:
            self._pool.remove(number)
            self._tracks.pop(number, None)
        if self._selected not in self._tracks:
            self._selected = next(reversed(self._tracks), None)

    def _drop_all(self) -> None:
        if self._tracks:
            self._drop(*self._tracks)
            self.tell("all targets were stopped")

    def _in_tracker(self, work: Callable[[], T]) -> T:
        """Run ``work`` in the tracker's thread, between two frames, and return its result once `newest` shows it.

        Raises:
            BusyError: too much is waiting, or no answer came in time; then the work is not done later either,
                unless it was begun.
        """
        future: Future[T] = Future()

        def run() -> Callable[[], None] | None:
            if not future.set_running_or_notify_cancel():
                return None
            try:
                result = work()
            except BaseException as error:  # belongs to the one who asked
                return partial(future.set_exception, error)
            return partial(future.set_result, result)

        with self._changed:
            if self._stop.is_set() or self.failure is not None:
                raise BusyError("shutting down")
            if len(self._commands) >= _MAX_WAITING:
                raise BusyError("too many commands are waiting: try again")
            self._commands.append(run)
            self._changed.notify_all()
        # `wait` instead of a timed `result`: before Python 3.11 the latter's error is not the builtin TimeoutError
        for _ in range(2):
            if wait([future], timeout=_ANSWER_S).done:
                return future.result()
            if future.cancel():
                break
        raise BusyError("the tracker did not answer in time: try again")

    def _follow(self) -> None:
        while not self._stop.is_set():
            with self._changed:
                while not (self._incoming or self._commands or self._stop.is_set()):
                    self._changed.wait()
                incoming, self._incoming = self._incoming, None
                commands = list(self._commands)
                self._commands.clear()
            answers = [command() for command in commands]
            if commands and self.newest is not None:
                self._publish(self.newest.image, self.newest.read_at, self.newest.tracker_s, new=False)
            for answer in filter(None, answers):
                answer()
            if incoming is not None:
                image, read_at = incoming
                start = time.perf_counter()
                self._update(image)
                now = time.perf_counter()
                self._publish(image, read_at, now - start, new=True)
                if self._last_at:
                    self._intervals.append(now - self._last_at)
                self._last_at = 0.0 if self.paused else now

    def _update(self, image: Image) -> None:
        before, self._tracks = self._tracks, self._pool.update(image)
        for number, track in self._tracks.items():
            was = before[number].state
            if track.state != was and "lost" in (track.state, was):
                self.tell(f"target {number} was lost" if track.state == "lost" else f"target {number} was found again")

    def _publish(self, image: Image, read_at: float, tracker_s: float, new: bool) -> None:
        number = (self.newest.number if self.newest else 0) + new
        if new:
            self.ring.add(number, image)
        self.newest = Shot(number, image, read_at, dict(self._tracks), self._selected, tracker_s)
        self._notify()

    def _notify(self) -> None:
        for listener in list(self.listeners):
            listener()

    def _take(self, image: Image, read_at: float) -> None:
        """Keep a frame for the tracker; a frame that was not looked at in time is dropped."""
        self.read_at = read_at
        with self._changed:
            self._incoming = (image, read_at)
            self._changed.notify_all()

    def _jumped(self, again: bool) -> None:
        """Drop the targets of a file that starts again, or is played from elsewhere.

        Queued whatever waits already, and not waited for: the reader has nobody to pass a refusal on to.
        """

        def work() -> None:
            self.ring.clear()
            self._last_at = 0.0
            if self._tracks and again:
                self.tell(f"{self.name} starts again")
            self._drop_all()

        with self._changed:
            self._incoming = None
            self._commands.append(work)
            self._changed.notify_all()

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
