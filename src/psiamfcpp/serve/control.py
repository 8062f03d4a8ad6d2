"""Who may command, how often, and what the commands are: the same for the page, the API and MAVLink."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image
from psiamfcpp.serve.follower import Follower
from psiamfcpp.serve.limits import Bucket
from psiamfcpp.serve.propose import find_box, propose_box
from psiamfcpp.serve.recorder import Recorder

# Each start runs the template branch once; a hand never asks for more than this.
_COMMANDS_PER_S, _COMMANDS_AT_ONCE = 5.0, 10.0
LEASE_S = 15.0


class NotOperatorError(UserError):
    """Another client is in control."""


class TooManyError(UserError):
    """Commands come faster than they are taken."""


class Lease:
    """Who controls: whoever took it first, until it is released or its holder gave no sign of life for a while.

    Another client may ask for it. While it still does, it is next when control is released.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._lock = threading.Lock()
        self._holder: str | None = None
        self._seen = 0.0
        self._asking: str | None = None
        self._asked = 0.0

    @property
    def holder(self) -> str | None:
        """The client in control."""
        with self._lock:
            return self._current()

    def claim(self, client: str) -> bool:
        """Take control if nobody has it; whether the client now has it."""
        with self._lock:
            if self._current() in (None, client):
                self._holder, self._seen = client, self._clock()
                self._asking = None if self._asking == client else self._asking
            return self._holder == client

    @property
    def asking(self) -> str | None:
        """The client that asks for control, for a while after it did."""
        with self._lock:
            return self._next()

    def ask(self, client: str) -> bool:
        """Take control if nobody has it, else ask for it; whether the client now has it."""
        if self.claim(client):
            return True
        with self._lock:
            self._asking, self._asked = client, self._clock()
        return False

    def keep(self, client: str) -> None:
        """A sign of life."""
        with self._lock:
            if self._current() == client:
                self._seen = self._clock()

    def release(self, client: str) -> None:
        """Give control up, if the client has it, to the one that asks for it."""
        with self._lock:
            if self._current() == client:
                self._holder, self._seen = self._next(), self._clock()
                self._asking = None

    def _next(self) -> str | None:
        return self._asking if self._clock() - self._asked <= LEASE_S else None

    def _current(self) -> str | None:
        if self._holder is not None and self._clock() - self._seen > LEASE_S:
            self._holder = None
        return self._holder


class Control:
    """The commands. Each takes the name of the client that gives it, and blocks until it is carried out.

    All raise `NotOperatorError` while another client is in control, `TooManyError` above the allowed rate,
    `BusyError` where it may succeed later, and another `UserError` where what is asked for is wrong. A client that
    commands while nobody is in control takes it.
    """

    def __init__(self, follower: Follower, recorder: Recorder | None = None):
        self.follower, self.recorder = follower, recorder
        self.lease = Lease()
        self._bucket = Bucket(_COMMANDS_PER_S, _COMMANDS_AT_ONCE)

    def start(self, client: str, box: Box, frame: int | None = None, replace: int | None = None) -> tuple[int, Box]:
        """Follow the target in a box ``(x, y, w, h)``, pixels of a frame (see `Follower.add`); its number and box."""
        self._admit(client)
        number, track = self.follower.add(box, frame=frame, replace=replace)
        return number, track.box

    def start_at(
        self,
        client: str,
        x: float,
        y: float,
        frame: int | None = None,
        replace: int | None = None,
        or_square: bool = True,
    ) -> tuple[int, Box]:
        """Follow what lies under a point, pixels of a frame; its number and its box.

        Where nothing is found there, a small square is followed, or without ``or_square`` it is refused.
        """
        self._admit(client)
        image = self.follower.image(frame)
        box = propose_box(image, x, y) if or_square else _found(image, x, y)
        number, track = self.follower.add(box, image, frame, replace)
        return number, track.box

    def hold(self, client: str, frame: int | None) -> None:
        """Keep a frame on which the client draws, until it holds another, or none."""
        if self.lease.holder not in (None, client):
            raise NotOperatorError("another client is in control: wait until it hands over or leaves")
        if frame is None:
            self.follower.ring.release(client)
        elif not self.follower.ring.hold(client, frame):
            self.follower.image(frame)  # says why not

    def propose(self, client: str, x: float, y: float) -> Box:
        """The box that a point would be given."""
        self._admit(client)
        return propose_box(self.follower.image(None), x, y)

    def pause(self, client: str, on: bool) -> None:
        """Stop playing a file, or go on."""
        self._admit(client)
        self.follower.pause(on)

    def seek(self, client: str, frame: int) -> None:
        """Play a file from another frame on, numbered from 0."""
        self._admit(client)
        self.follower.seek(frame)

    def stop(self, client: str, number: int | None = None) -> None:
        """Stop a target, or all."""
        self._admit(client)
        if number is None:
            self.follower.clear()
        else:
            self.follower.remove(number)

    def select(self, client: str, number: int) -> None:
        """Choose the target that MAVLink speaks of."""
        self._admit(client)
        self.follower.select(number)

    def take(self, client: str) -> None:
        """Take control without commanding anything; where another client has it, that one sees that it is asked for."""
        if not self.lease.ask(client):
            raise NotOperatorError("another client is in control: it was asked to hand over")
        self._admit(client)

    def record(self, client: str, on: bool) -> None:
        """Begin or end a recording."""
        self._admit(client)
        if self.recorder is None:
            raise UserError("nothing can be recorded: start the server with --record FOLDER")
        if on:
            self.recorder.start()
        else:
            self.recorder.stop()

    def _admit(self, client: str) -> None:
        if not self.lease.claim(client):
            raise NotOperatorError("another client is in control: wait until it hands over or leaves")
        if not self._bucket.take():
            raise TooManyError(f"too many commands: at most {_COMMANDS_PER_S:g} a second are taken")


def _found(image: Image, x: float, y: float) -> Box:
    box = find_box(image, x, y)
    if box is None:
        raise UserError("nothing to follow was found there: draw a box round it")
    return box
