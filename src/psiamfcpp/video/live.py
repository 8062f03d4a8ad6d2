"""The newest frame of a camera or a network stream, kept by a thread that also brings back what drops."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.video.capture import FALLBACK_FPS, ended_early, open_capture, sane_count, sane_fps

_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.25, 4.0
# a wait without an end cannot be interrupted with Ctrl-C everywhere
_POLL_S = 0.2


class LiveReader:
    """Reads a camera or an address in a thread of its own and keeps nothing but the newest frame."""

    def __init__(
        self,
        target: int | str,
        name: str,
        on_event: Callable[[str], None] | None,
        reconnect_s: float,
        timeout_s: float,
    ) -> None:
        """Open the target, wait for its first frame and start reading.

        Args:
            target: camera number or address.
            name: what messages call it.
            on_event: receives one line when the target breaks off and when it is back.
            reconnect_s: seconds of silence after which the target is given up.
            timeout_s: seconds that opening or a frame may take.

        Raises:
            UserError: it cannot be opened or gives no frame.
        """
        self._target, self._name, self._on_event = target, name, on_event
        self._reconnect_s, self._timeout_s = reconnect_s, timeout_s
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._newest: Image | None = None
        self._read = 0
        self._events: list[str] = []
        self._error: BaseException | None = None
        self._done = False
        opened = self._connect(timeout_s)
        if opened is None:
            fix = (
                "check that it is plugged in, permitted and not in use"
                if isinstance(target, int)
                else "check the address and that it is being served"
            )
            raise UserError(f"{name} cannot be opened or gives no frame: {fix}")
        capture, first = opened
        self._length, self._rate = sane_count(capture), sane_fps(capture)
        self.fps = self._rate or FALLBACK_FPS
        self._publish(first)
        self._thread = threading.Thread(target=self._run, args=(capture,), name=f"frames of {name}", daemon=True)
        self._thread.start()

    def frames(self) -> Iterator[Image]:
        """Frames ``(H, W, 3)`` uint8 BGR, each newer than the one before; waits where there is none yet.

        Raises:
            UserError: the target broke off and did not come back in time.
        """
        seen = 0
        while True:
            with self._changed:
                if not self._events and self._read == seen and not self._done:
                    self._changed.wait(_POLL_S)
                events, self._events = self._events, []
                frame, number, done = self._newest, self._read, self._done
            for event in events:
                if self._on_event is not None:
                    self._on_event(event)
            if number > seen and frame is not None:
                seen = number
                yield frame
            elif done:
                if self._error is not None:
                    raise self._error
                return

    def close(self) -> None:
        """Stop reading and wait for the thread to end: as long as one frame may take."""
        self._stop.set()
        self._thread.join()

    def _run(self, capture: cv2.VideoCapture) -> None:
        current: cv2.VideoCapture | None = capture
        try:
            while current is not None:
                self._pump(current)
                current.release()
                current = None if self._stop.is_set() or self._ended() else self._reconnect()
        except BaseException as error:  # whoever waits for a frame must hear of it, whatever it is
            self._error = error
        finally:
            if current is not None:
                current.release()
            with self._changed:
                self._done = True
                self._changed.notify_all()

    def _pump(self, capture: cv2.VideoCapture) -> None:
        """Publish frames until they stop coming."""
        start = time.monotonic()
        first = self._read
        while not self._stop.is_set():
            ok, frame = capture.read()
            if not ok:
                return
            if self._length is not None:
                # a file behind an address comes as fast as it is read: unpaced, most of it would be skipped
                due = start + (self._read - first + 1) / self.fps
                self._stop.wait(max(0.0, due - time.monotonic()))
            self._publish(np.asarray(frame, dtype=np.uint8))

    def _publish(self, frame: Image) -> None:
        with self._changed:
            self._newest = frame
            self._read += 1
            self._changed.notify_all()

    def _ended(self) -> bool:
        """Whether this was a file that is over: to open it again would only play it from its start."""
        if self._length is None:
            return False
        if ended_early(self._read, 0.0, self._length, self._rate):
            raise UserError(f"{self._name} broke off: {self._read} of {self._length} frames came; check the connection")
        return True

    def _reconnect(self) -> cv2.VideoCapture | None:
        """The target opened anew, its first frame published; None if reading was stopped meanwhile.

        Raises:
            UserError: it did not come back in time.
        """
        lost, wait, count = time.monotonic(), _FIRST_WAIT_S, self._read
        end = lost + self._reconnect_s
        limit = f"{self._reconnect_s:g} s"
        patience = f"for {limit}" if math.isfinite(self._reconnect_s) else "without end"
        self._tell(f"{self._name} stopped after {count} frames: trying {patience} to bring it back")
        while (left := end - time.monotonic()) > 0:
            if self._stop.wait(min(wait, left)):
                return None
            opened = self._connect(min(self._timeout_s, max(0.1, end - time.monotonic())))
            if opened is not None:
                self._tell(f"{self._name} is back after {time.monotonic() - lost:.1f} s")
                self._publish(opened[1])
                return opened[0]
            wait = min(2 * wait, _LONGEST_WAIT_S)
        raise UserError(
            f"{self._name} stopped after {count} frames and did not come back within {limit}: "
            "check the device or the connection and start again"
        )

    def _connect(self, timeout_s: float) -> tuple[cv2.VideoCapture, Image] | None:
        """The target opened, and its first frame; None where either fails."""
        capture = open_capture(self._target, timeout_s)
        if capture.isOpened():
            ok, frame = capture.read()
            if ok:
                return capture, np.asarray(frame, dtype=np.uint8)
        capture.release()
        return None

    def _tell(self, event: str) -> None:
        with self._changed:
            self._events.append(event)
            self._changed.notify_all()
