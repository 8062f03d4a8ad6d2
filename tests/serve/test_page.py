"""The page in a real browser: a box is drawn, followed, and found again after the server was away."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from psiamfcpp.geometry import centre_error
from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import Follower

from .conftest import BLOB, TIMEOUT_S, Stream, free_port, served, until

pytestmark = pytest.mark.slow
LIVE = "#link[data-kind=good]"


@pytest.fixture
def visit(browser: Any) -> Iterator[Callable[..., Any]]:
    """Opens a page and fails if a script of it does."""
    faults: list[str] = []
    contexts: list[Any] = []

    def open_page(address: str, width: int = 1000, height: int = 700, touch: bool = False) -> Any:
        context = browser.new_context(viewport={"width": width, "height": height}, has_touch=touch)
        context.set_default_timeout(1000 * TIMEOUT_S)
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda fault: faults.append(str(fault)))
        page.goto(f"http://{address}/")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert faults == []


def shown_at(page: Any) -> dict[str, float]:
    """Where the image lies on the canvas, and how large, in pixels of the screen."""
    # Not by wait_for_function, which evaluates a string again and again: the page's own rules forbid that.
    data = until(lambda: page.evaluate("({...document.getElementById('picture').dataset})"))
    return {name: float(value) for name, value in data.items()}


def place(page: Any, x: float, y: float) -> tuple[float, float]:
    """Where a pixel of the frame is on the screen."""
    at = shown_at(page)
    area = page.locator("#picture").bounding_box()
    return area["x"] + at["left"] + x * at["scale"], area["y"] + at["top"] + y * at["scale"]


def drag(page: Any, box: tuple[float, ...] = BLOB) -> None:
    """Draw a box with the mouse."""
    x, y, w, h = box
    page.mouse.move(*place(page, x, y))
    page.mouse.down()
    page.mouse.move(*place(page, x + w / 2, y + h / 3))
    page.mouse.move(*place(page, x + w, y + h))
    page.mouse.up()


def green(page: Any, x: float, y: float) -> bool:
    """Whether a pixel of the canvas has the colour of a target that is tracked."""
    at = shown_at(page)
    left, top = at["left"] + x * at["scale"], at["top"] + y * at["scale"]
    r, g, b = page.evaluate(
        f"[...document.getElementById('picture').getContext('2d').getImageData({left}, {top}, 1, 1).data].slice(0, 3)"
    )
    return bool(g > r + 60 and g > b + 60)


def test_a_box_that_is_drawn_is_followed_and_stopped(
    visit: Callable[..., Any], address: str, follower: Follower, stream: Stream
) -> None:
    page = visit(address)
    page.wait_for_selector(LIVE)
    drag(page)
    page.wait_for_selector("#targets .state.tracking")
    assert follower.newest is not None
    assert centre_error(follower.newest.tracks[1].box, BLOB) < 2
    for step in range(1, 6):
        stream.blobs = [(100 + 12 * step, 80 + 6 * step, 40, 30)]
        until(lambda: centre_error(follower.newest.tracks[1].box, stream.blobs[0]) < 1)  # type: ignore[union-attr]
    # the outline on the canvas is where the target is now
    until(lambda: green(page, 160 + 20, 110 + 30) and not green(page, 120, 110))
    assert page.inner_text("#role") == "you control"
    assert float(page.inner_text("#latency")) > 0
    assert int(page.inner_text("#fps")) > 0
    page.click("#stop")
    page.wait_for_selector("#empty:visible")
    until(lambda: not follower.newest.tracks)  # type: ignore[union-attr]


def test_a_tap_on_a_phone_is_enough(visit: Callable[..., Any], address: str, follower: Follower) -> None:
    page = visit(address, 390, 780, touch=True)
    page.wait_for_selector(LIVE)
    page.touchscreen.tap(*place(page, 119, 94))
    page.wait_for_selector("#targets .state.tracking")
    assert follower.newest is not None
    assert follower.newest.tracks[1].box == pytest.approx(BLOB, abs=3)
    # nothing is wider than the screen
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


def test_a_second_page_watches(visit: Callable[..., Any], address: str, follower: Follower) -> None:
    first = visit(address)
    first.wait_for_selector(LIVE)
    drag(first)
    first.wait_for_selector("#targets .state.tracking")
    second = visit(address)
    second.wait_for_selector("#targets .state.tracking")
    assert second.inner_text("#role") == "another controls"
    assert second.is_disabled("#stop")
    drag(second)
    first.click("#operator")
    second.wait_for_selector("#operator:has-text('Take control')")
    assert follower.newest is not None
    assert list(follower.newest.tracks) == [1]


def test_a_server_that_was_away_is_found_again(visit: Callable[..., Any], control: Control) -> None:
    # a port that no other program gets while nobody listens
    port = free_port(socket.SOCK_STREAM)
    with served(control, port) as address:
        page = visit(address)
        page.wait_for_selector(LIVE)
        drag(page)
        page.wait_for_selector("#targets .state.tracking")
    page.wait_for_selector("#banner:visible")
    assert "No connection" in page.inner_text("#banner")
    # nothing is offered that cannot be had, and nothing shown that is not known
    assert page.locator("aside button:enabled").count() == 0
    assert page.inner_text("#fps") == "\u2013"
    assert not page.is_visible("#hint")
    with served(control, port):
        page.wait_for_selector(LIVE)
        page.wait_for_selector("#banner:visible", state="hidden")
        # and it is still in control
        page.wait_for_selector("#stop:not([disabled])")
        page.click("#stop")
        page.wait_for_selector("#empty:visible")


def test_a_stream_that_stops_is_said(
    visit: Callable[..., Any], address: str, stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psiamfcpp.serve.status._SILENT_S", 0.3)
    page = visit(address)
    page.wait_for_selector(LIVE)
    stream.silent = True
    # a busy machine may make the stream stop by itself, and go on before one looks
    page.wait_for_selector("#banner:visible:has-text('stream has stopped')")
    stream.silent = False
    page.wait_for_selector("#banner", state="hidden")


def test_the_token_is_asked_for(visit: Callable[..., Any], control: Control) -> None:
    with served(control, token="correct horse battery") as address:
        page = visit(address)
        page.wait_for_selector("#login[open]")
        page.fill("#token", "wrong one, wrong one")
        page.click("#login button")
        page.wait_for_selector("#wrong:visible")
        page.fill("#token", "correct horse battery")
        page.click("#login button")
        page.wait_for_selector(LIVE)


def test_nothing_of_the_page_outlives_it(visit: Callable[..., Any], address: str, control: Control) -> None:
    before = threading.active_count()
    for _ in range(3):
        page = visit(address)
        page.wait_for_selector(LIVE)
        page.context.close()
    until(lambda: threading.active_count() <= before + 4)  # the server's own helpers come as they are needed
