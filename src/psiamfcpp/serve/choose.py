"""A page on which targets are chosen in a source, before they are followed."""

from __future__ import annotations

import contextlib
import hmac
import itertools
import os
import secrets
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import anyio.to_thread
from fastapi import FastAPI, HTTPException, Response
from pydantic import Field

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image, check_box
from psiamfcpp.serve import messages
from psiamfcpp.serve.app import add_refusals
from psiamfcpp.serve.follower import MAX_TARGETS
from psiamfcpp.serve.guard import Guard
from psiamfcpp.serve.pages import HEADERS, add_files
from psiamfcpp.serve.pictures import jpeg
from psiamfcpp.serve.propose import find_box
from psiamfcpp.serve.reader import short_name
from psiamfcpp.serve.ring import Ring
from psiamfcpp.serve.server import bind, make_server
from psiamfcpp.video.source import Source

_PAGE = {"/": "choose.html", "/choose.js": "choose.js", "/view.js": "view.js", "/page.css": "page.css"}
# Frames that are read for one request on the way to a later one, so that the page shows how far it is.
_STRIDE = 100
_NEW_FRAME_S = 2.0
_HOLDER = "page"


@dataclass(frozen=True)
class Chosen:
    """What was chosen on the page."""

    start_frame: int
    """number of the frame that the boxes were drawn on, from 0 as `psiamfcpp.video.source.Source.seek` counts; of a
    live source, of those that were read while the page was open"""
    boxes: list[Box]
    """``(x, y, w, h)`` of each target, pixels, 0-based; at least one"""
    frames: Iterator[Image]
    """the source from that frame on; of a live one with the frames that came meanwhile, thinned out where they were
    many, and then the newest ones"""


def choose(source: Source, start: int = 0, ready: Callable[[str], None] | None = None) -> Chosen:
    """Have targets chosen on a local page, until somebody has.

    The page listens on 127.0.0.1, on a free port. Its address holds a token that lets one browser in, once.

    Args:
        source: where to choose: opened, nothing read from it yet.
        start: number of the frame to show first; not of a live source.
        ready: called with the address when the page can be opened; by default it is printed, and a browser opened.

    Raises:
        UserError: a frame cannot be read.
        KeyboardInterrupt: Ctrl-C, before anything was chosen.
    """
    with contextlib.ExitStack() as stack:
        frames = _Live(source) if source.live else _Files(source, start)
        if isinstance(frames, _Live):
            stack.enter_context(frames)
        desk = _Desk(source, frames)
        listener = bind("127.0.0.1", 0)
        stack.callback(listener.close)
        token, session = secrets.token_urlsafe(24), secrets.token_urlsafe(24)
        address = f"http://127.0.0.1:{listener.getsockname()[1]}/?token={token}"
        app = _build_app(desk, token, session)
        server = make_server(app, lambda: (ready or show_address)(address))
        listener.gate = app.gate

        def end() -> None:
            server.should_exit = True

        desk.done = end
        if isinstance(frames, _Live):
            frames.on_failure = end
        server.run([listener])
        if desk.chosen is None and isinstance(frames, _Live) and frames.failure is not None:
            raise frames.failure
        if desk.chosen is None:  # ended by a signal that the server took
            raise KeyboardInterrupt
        number, boxes = desk.chosen
    return Chosen(number, boxes, frames.following(number))


def show_address(address: str) -> None:
    """Print where the page is, and open it in a browser where there is a screen."""
    print(f"choose the target on {address} (Ctrl-C ends)", file=sys.stderr, flush=True)
    if os.environ.get("SSH_CONNECTION"):
        port = address.split(":")[2].partition("/")[0]
        print(f"from elsewhere, first: ssh -L {port}:127.0.0.1:{port} THIS-MACHINE", file=sys.stderr, flush=True)
        return
    screen = sys.platform in ("win32", "darwin") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if screen:
        # in a thread: a browser that runs in the terminal returns when it is closed
        threading.Thread(target=_open_browser, args=(address,), daemon=True).start()


def _open_browser(address: str) -> None:
    with contextlib.suppress(Exception):  # the address was printed
        webbrowser.open(address)


class _Files:
    """The frames of a file or folder, each by its number."""

    def __init__(self, source: Source, start: int):
        self._source, self.start = source, start
        self._lock = threading.Lock()
        self._far = -1
        self._held: tuple[int, Image] | None = None
        self.count: int | None = None
        """frames of the source, once its end was seen"""

    def get(self, number: int) -> tuple[int, Image]:
        """Return a frame, or one on the way to it; behind the end, the last one."""
        with self._lock:
            return self._get(min(number, self._far + _STRIDE))

    def image(self, number: int) -> Image:
        """Return the very frame of a number that was shown."""
        with self._lock:
            if self._held is None or self._held[0] != number:
                self._get(number)
            assert self._held is not None
            return self._held[1]

    def following(self, number: int) -> Iterator[Image]:
        """Return all frames from a number on."""
        self._source.seek(number)
        return self._source

    def _get(self, number: int) -> tuple[int, Image]:
        while True:
            if self.count is not None:
                number = min(number, self.count - 1)
            if self._held is not None and self._held[0] == number:
                return self._held
            image = self._read(number)
            if image is not None:
                self._held, self._far = (number, image), max(self._far, number)
                return self._held
            if number == 0:
                raise UserError(f"{self._source.name} holds no frame that can be read any more")
            # the container promised more frames than there are
            self.count = self._counted()

    def _read(self, number: int) -> Image | None:
        if self._held is None or self._held[0] + 1 != number:
            self._source.seek(number)
        try:
            return next(self._source, None)
        except UserError:  # cut off: what came before can be used
            return None

    def _counted(self) -> int:
        """How many frames there are: by reading the few from the furthest one to the end."""
        count, self._held = max(0, self._far), None
        self._source.seek(count)
        with contextlib.suppress(UserError):
            for _ in self._source:
                count += 1
        return count


class _Live:
    """The newest frame of a camera or stream, and those since one that is held."""

    start = 0
    count = None

    def __init__(self, source: Source):
        self._source, self._ring = source, Ring()
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._newest: tuple[int, Image] | None = None
        self.failure: BaseException | None = None
        self.on_failure: Callable[[], None] = lambda: None
        self._thread = threading.Thread(target=self._run, name="choose", daemon=True)

    def __enter__(self) -> _Live:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._stop.set()
        # the source is read on by another thread; after an error it is not, and may be silent for long
        if kind is None:
            self._thread.join()

    def get_after(self, number: int) -> tuple[int, Image]:
        """Return the newest frame, after a while at most; it may still be that of the number."""
        with self._changed:
            self._changed.wait_for(
                lambda: self.failure or (self._newest is not None and self._newest[0] > number), _NEW_FRAME_S
            )
            if self.failure is not None:
                raise self.failure
            if self._newest is None:
                raise UserError(f"{self._source.name} has given no frame yet: wait a moment")
            return self._newest

    def hold(self, number: int) -> bool:
        """Keep a frame, and a chain of frames from there to the newest."""
        return self._ring.hold(_HOLDER, number)

    def image(self, number: int) -> Image:
        """Return a frame that is held, or still there."""
        found = self._ring.since(number)
        if not found:
            raise UserError("the frame that this was drawn on is no longer kept: draw on the image as it is now")
        return found[0][1]

    def following(self, number: int) -> Iterator[Image]:
        """Return the frames from a number on, then those that come."""
        return itertools.chain([image for _, image in self._ring.since(number)], self._source)

    def _run(self) -> None:
        try:
            for number, image in enumerate(self._source, start=1):
                self._ring.add(number, image)
                with self._changed:
                    self._newest = number, image
                    self._changed.notify_all()
                if self._stop.is_set():
                    return
            raise UserError(f"{self._source.name} has ended")
        except BaseException as error:  # whoever asks next must hear of it
            with self._changed:
                self.failure = error
                self._changed.notify_all()
            self.on_failure()


class _Desk:
    """What the page asks for."""

    def __init__(self, source: Source, frames: _Files | _Live):
        self.source, self.frames = source, frames
        self.chosen: tuple[int, list[Box]] | None = None
        self.done: Callable[[], None] = lambda: None

    def about(self) -> dict[str, Any]:
        """What the page must know of the source."""
        frames = self.frames
        first = frames.get_after(0)[1] if isinstance(frames, _Live) else frames.get(frames.start)[1]
        height, width = first.shape[:2]
        return {
            "name": short_name(self.source),
            "live": self.source.live,
            "fps": self.source.fps,
            "frames": self.source.frame_count,
            "start": frames.start,
            "width": width,
            "height": height,
        }

    def frame(self, number: int | None, after: int | None) -> tuple[int, bytes]:
        """Return a frame's number and its JPEG."""
        if isinstance(self.frames, _Live):
            found, image = self.frames.get_after(after or 0)
        else:
            found, image = self.frames.get(number or 0)
        return found, jpeg(image)

    def hold(self, number: int) -> None:
        """Keep a frame of a live source."""
        if isinstance(self.frames, _Live) and not self.frames.hold(number):
            self.frames.image(number)  # says why not

    def propose(self, number: int, x: float, y: float) -> Box | None:
        """The box of what lies under a point of a frame."""
        return find_box(self.frames.image(number), x, y)

    def choose(self, number: int, boxes: list[Box]) -> None:
        """End the page with these boxes."""
        image = self.frames.image(number)
        for box in boxes:
            check_box(box, image.shape)
        # as they are printed, so that the same command again follows the same boxes
        self.chosen = number, [(round(x, 1), round(y, 1), round(w, 1), round(h, 1)) for x, y, w, h in boxes]


class _HoldBody(messages.Strict):
    frame: messages.FrameNumber


class _ProposeBody(messages.PointBody):
    frame: messages.FrameNumber


class _ChooseBody(messages.Strict):
    frame: messages.FrameNumber
    boxes: list[messages.Box] = Field(min_length=1, max_length=MAX_TARGETS)


def _build_app(desk: _Desk, token: str, session: str) -> Guard:
    app = FastAPI(title="P-SiamFC++", docs_url=None, redoc_url=None, openapi_url=None)
    guarded = Guard(app, session)
    add_refusals(app)
    add_files(app, _PAGE)
    run = anyio.to_thread.run_sync
    left = [token]

    @app.post("/api/enter")
    async def enter(body: messages.LoginBody) -> dict[str, str]:
        if not left or not hmac.compare_digest(body.token.encode(), left[0].encode()):
            raise HTTPException(401, "this address was opened before: use that window, or start the command again")
        left.clear()
        return {"session": session}

    @app.get("/api/source")
    async def about() -> dict[str, Any]:
        return await run(desk.about)

    @app.get("/api/frame")
    async def frame(number: messages.FrameNumber | None = None, after: int | None = None) -> Response:
        found, data = await run(desk.frame, number, after)
        headers = {**HEADERS, "X-Frame": str(found)}
        if desk.frames.count is not None:
            headers["X-Count"] = str(desk.frames.count)
        return Response(data, media_type="image/jpeg", headers=headers)

    @app.post("/api/hold")
    async def hold(body: _HoldBody) -> dict[str, bool]:
        await run(desk.hold, body.frame)
        return {"ok": True}

    @app.post("/api/propose")
    async def propose(body: _ProposeBody) -> dict[str, Box | None]:
        return {"box": await run(desk.propose, body.frame, *body.point)}

    @app.post("/api/choose")
    async def decide(body: _ChooseBody) -> dict[str, bool]:
        await run(desk.choose, body.frame, body.boxes)
        desk.done()
        return {"ok": True}

    return guarded
