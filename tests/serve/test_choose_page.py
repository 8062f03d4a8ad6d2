"""The page on which targets are chosen before a source is followed, in a real browser."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest

from psiamfcpp.serve.choose import Chosen, choose
from psiamfcpp.video.source import Source, open_source

from . import test_page
from .conftest import BLOB, Stream, until
from .test_page import place, shown_at

pytestmark = pytest.mark.slow
visit = test_page.visit
COUNT = 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, blob_frame: Callable[..., Any]) -> Path:
    """Images of a blob that moves by 3 pixels."""
    path = tmp_path_factory.mktemp("frames")
    for number in range(COUNT):
        cv2.imwrite(str(path / f"{number}.png"), blob_frame(box_at(number), width=480, height=320))
    return path


def box_at(number: int) -> tuple[float, float, float, float]:
    return (20.0 + 3 * number, 80.0, 40.0, 30.0)


class Opened:
    """`choose` in a thread, and a page on it."""

    def __init__(self, source: Source, visit: Callable[..., Any], width: int = 1280, height: int = 800, **options: Any):
        self.result: Chosen | None = None
        ready, where = threading.Event(), [""]

        def shown(address: str) -> None:
            where[0] = address
            ready.set()

        def run() -> None:
            self.result = choose(source, ready=shown)

        self.thread = threading.Thread(target=run)
        self.thread.start()
        assert ready.wait(60)
        # `visit` adds a slash, which must not become part of the token
        self.address = where[0].removeprefix("http://") + "&end="
        self.page = visit(self.address, width, height, **options)
        self.page.wait_for_selector("#link[data-kind=good]")
        shown_at(self.page)

    def drag(self, box: tuple[float, ...]) -> None:
        x, y, w, h = box
        self.page.mouse.move(*place(self.page, x, y))
        self.page.mouse.down()
        self.page.mouse.move(*place(self.page, x + w / 2, y + h / 2))
        self.page.mouse.move(*place(self.page, x + w, y + h))
        self.page.mouse.up()

    def boxes(self) -> list[str]:
        return list(self.page.locator("#targets .words").all_inner_texts())

    def chosen(self) -> Chosen:
        self.thread.join(60)
        assert not self.thread.is_alive()
        assert self.result is not None
        return self.result

    def end(self) -> None:
        if self.thread.is_alive():
            self.page.keyboard.press("Escape")
            self.drag((30, 30, 40, 40))
            self.page.click("#follow")
        self.thread.join(60)


@pytest.fixture
def video(folder: Path) -> Iterator[Source]:
    with open_source(folder) as source:
        yield source


@pytest.fixture
def opened(video: Source, visit: Callable[..., Any]) -> Iterator[Opened]:
    running = Opened(video, visit)
    yield running
    running.end()


def test_a_frame_and_targets_are_chosen_and_enter_follows(opened: Opened) -> None:
    page = opened.page
    assert "token" not in page.url
    assert page.is_disabled("#follow")
    page.focus("#slider")
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    page.wait_for_selector("#moment:has-text('frame 4')")
    page.focus("#picture")
    page.keyboard.press(".")
    page.wait_for_selector("#moment:has-text('frame 5')")
    opened.drag(box_at(5))
    until(lambda: opened.boxes() == ["35, 80, 40, 30"])
    page.keyboard.press("a")
    opened.drag((200, 100, 60, 60))
    until(lambda: opened.boxes() == ["35, 80, 40, 30", "200, 100, 60, 60"])
    page.keyboard.press("Enter")
    page.wait_for_selector("#banner:visible:has-text('Following has begun')")
    chosen = opened.chosen()
    assert chosen.start_frame == 5
    assert chosen.boxes[0] == pytest.approx(box_at(5), abs=1)
    assert chosen.boxes[1] == pytest.approx((200, 100, 60, 60), abs=1)
    assert next(chosen.frames)[95, 40, 0] > 200


def test_a_tap_proposes_and_drawing_again_replaces(opened: Opened) -> None:
    page = opened.page
    page.mouse.click(*place(page, 40, 95))
    until(lambda: len(opened.boxes()) == 1)
    x, y, w, h = (int(v) for v in opened.boxes()[0].split(","))
    assert (x, y, w, h) == pytest.approx(box_at(0), abs=3)
    opened.drag((10, 70, 60, 50))
    until(lambda: opened.boxes() == ["10, 70, 60, 50"])
    page.keyboard.press("Delete")
    page.wait_for_selector("#empty:visible")
    assert page.is_disabled("#follow")


def test_a_tap_on_nothing_says_so(opened: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.choose.find_box", lambda *_: None)
    opened.page.mouse.click(*place(opened.page, 300, 200))
    opened.page.wait_for_selector("#banner:visible:has-text('Nothing to follow was found')")


def test_another_frame_drops_the_boxes_and_says_so(opened: Opened) -> None:
    opened.drag(box_at(0))
    until(lambda: len(opened.boxes()) == 1)
    opened.page.click("#forth")
    opened.page.wait_for_selector("#moment:has-text('frame 1')")
    opened.page.wait_for_selector("#banner:visible:has-text('another frame')")
    assert opened.boxes() == []


def test_the_end_is_reached(opened: Opened) -> None:
    opened.page.focus("#slider")
    opened.page.keyboard.press("End")
    opened.page.wait_for_selector(f"#moment:has-text('frame {COUNT - 1}')")
    opened.page.keyboard.press("Home")
    opened.page.wait_for_selector("#moment:has-text('frame 0')")


def test_a_reload_stays_inside_and_a_second_browser_stays_out(opened: Opened, visit: Callable[..., Any]) -> None:
    opened.page.reload()
    opened.page.wait_for_selector("#link[data-kind=good]")
    other = visit(opened.address)
    other.wait_for_selector("#banner:visible:has-text('opened before')")


@pytest.mark.parametrize(("width", "height"), [(390, 844), (844, 390)])
def test_on_a_phone_it_fits_and_fingers_draw(video: Source, visit: Callable[..., Any], width: int, height: int) -> None:
    opened = Opened(video, visit, width, height, touch=True)
    page = opened.page
    page.touchscreen.tap(*place(page, 40, 95))
    until(lambda: len(opened.boxes()) == 1)
    box = page.locator("#follow").bounding_box()
    assert box["x"] >= 0 and box["x"] + box["width"] <= width
    assert box["y"] >= 0 and box["y"] + box["height"] <= height
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.touchscreen.tap(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert opened.chosen().boxes[0] == pytest.approx(box_at(0), abs=3)


def test_a_live_stream_stands_still_while_one_draws(stream: Stream, visit: Callable[..., Any]) -> None:
    source = stream.open(print)
    opened = Opened(source, visit)
    page = opened.page
    x, y, w, h = BLOB
    page.mouse.move(*place(page, x, y))
    page.mouse.down()
    page.wait_for_selector("#resume:visible")
    page.mouse.move(*place(page, x + w, y + h))
    page.mouse.up()
    stream.blobs = [(400.0, 300.0, 40.0, 30.0)]
    page.wait_for_selector("#targets li")
    # given up, it moves on
    page.click("#resume")
    page.wait_for_selector("#empty:visible")
    at = shown_at(page)
    left, top = at["left"] + 420 * at["scale"], at["top"] + 315 * at["scale"]
    code = f"document.getElementById('picture').getContext('2d').getImageData({left}, {top}, 1, 1).data[2]"
    until(lambda: page.evaluate(code) > 200)
    opened.drag(stream.blobs[0])
    page.wait_for_selector("#targets li")
    stream.blobs = [BLOB]
    page.keyboard.press("Enter")
    chosen = opened.chosen()
    assert chosen.boxes[0] == pytest.approx((400, 300, 40, 30), abs=2)
    assert next(chosen.frames)[315, 420, 0] > 200
    until(lambda: next(chosen.frames)[95, 120, 0] > 200)
    source.close()
