"""What an operator does on the page in a real browser: by mouse, by fingers and by keys, on screens of three sizes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import httpx
import pytest

from psiamfcpp import TargetPool
from psiamfcpp.geometry import centre_error
from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import Follower
from psiamfcpp.serve.recorder import Recorder
from psiamfcpp.video.source import open_source

from . import test_page
from .conftest import BLOB, HEIGHT, WIDTH, Stream, served, until
from .test_page import LIVE, drag, green, place, shown_at

pytestmark = pytest.mark.slow
visit = test_page.visit
SIZES = [(1280, 800), (390, 844), (844, 390)]


@pytest.fixture
def page(visit: Callable[..., Any], address: str) -> Any:
    """A page that shows the stream."""
    opened = visit(address, 1280, 800)
    opened.wait_for_selector(LIVE)
    return opened


def targets(follower: Follower) -> list[int]:
    return sorted(follower.newest.tracks) if follower.newest else []


def blue_at(page: Any, x: float, y: float) -> int:
    """Brightness of the canvas where a pixel of the frame is shown; the blob is white, the ground is dark."""
    at = shown_at(page)
    left, top = at["left"] + x * at["scale"], at["top"] + y * at["scale"]
    code = f"document.getElementById('picture').getContext('2d').getImageData({left}, {top}, 1, 1).data[2]"
    return int(page.evaluate(code))


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_image_fills_its_place_and_nothing_is_cut(
    visit: Callable[..., Any], address: str, follower: Follower, width: int, height: int
) -> None:
    for number in range(3):
        follower.add((BLOB[0] + number, *BLOB[1:]))
    page = visit(address, width, height)
    page.wait_for_selector("#targets li:nth-child(3)")
    at = shown_at(page)
    area = page.locator("#picture").bounding_box()
    assert at["scale"] == pytest.approx(min(area["width"] / WIDTH, area["height"] / HEIGHT), rel=0.01)
    # the stage is most of the screen's shorter side
    assert max(area["width"] / width, area["height"] / height) > 0.5
    for name in ("stop", "snapshot", "operator", "keys-box", "fullscreen", "theme"):
        box = page.locator(f"#{name}").bounding_box()
        assert box["x"] >= 0 and box["y"] >= 0
        assert box["x"] + box["width"] <= width
        assert box["y"] + box["height"] <= height
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate("document.documentElement.scrollHeight") <= height


def test_the_wheel_zooms_about_the_pointer_and_boxes_stay_true(page: Any, follower: Follower) -> None:
    whole = shown_at(page)["scale"]
    at = place(page, 120, 95)
    page.mouse.move(*at)
    page.mouse.wheel(0, -600)
    until(lambda: shown_at(page)["scale"] > 2 * whole)
    # the browser gives whole pixels of the screen
    assert place(page, 120, 95) == pytest.approx(at, abs=4)
    drag(page, BLOB)
    page.wait_for_selector("#targets .state.tracking")
    assert follower.newest is not None
    assert centre_error(follower.newest.tracks[1].box, BLOB) < 1
    page.keyboard.press("0")
    until(lambda: shown_at(page)["scale"] == pytest.approx(whole))


def test_two_fingers_zoom_and_draw_nothing(
    visit: Callable[..., Any], address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psiamfcpp.serve.control.find_box", lambda *_: None)
    page = visit(address, 390, 844, touch=True)
    page.wait_for_selector(LIVE)
    whole = shown_at(page)["scale"]
    x, y = place(page, 320, 240)
    touch = page.context.new_cdp_session(page)

    def fingers(kind: str, *points: tuple[float, float]) -> None:
        spots = [{"x": px, "y": py, "id": number} for number, (px, py) in enumerate(points)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": spots})

    fingers("touchStart", (x - 20, y))
    fingers("touchStart", (x - 20, y), (x + 20, y))
    for spread in (30, 45, 60):
        fingers("touchMove", (x - spread, y), (x + spread, y))
    fingers("touchEnd")
    until(lambda: shown_at(page)["scale"] == pytest.approx(3 * whole, rel=0.1))
    assert page.locator("#targets li").count() == 0
    # and one finger draws again
    page.touchscreen.tap(*place(page, 310, 235))
    page.wait_for_selector("#banner:visible:has-text('nothing to follow')")


def test_the_image_stands_still_while_one_draws_and_the_target_catches_up(
    page: Any, follower: Follower, stream: Stream
) -> None:
    until(lambda: blue_at(page, 120, 95) > 200)
    x, y, w, h = BLOB
    page.mouse.move(*place(page, x, y))
    page.mouse.down()
    page.mouse.move(*place(page, x + 10, y + 10))
    until(lambda: follower.ring._holds)
    for step in range(1, 13):
        stream.blobs = [(x + 12 * step, y, w, h)]
        before = follower.newest.number if follower.newest else 0
        until(lambda before=before: follower.newest and follower.newest.number >= before + 2)
    # the operator still sees it where he began to draw
    assert blue_at(page, 130, 100) > 200
    assert "stands still" in page.inner_text("#hint")
    page.mouse.move(*place(page, x + w, y + h))
    page.mouse.up()
    until(lambda: targets(follower) == [1])
    until(lambda: centre_error(follower.newest.tracks[1].box, stream.blobs[0]) < 1)  # type: ignore[union-attr]
    assert [event.text for event in follower.events()] == ["target 1 is followed"]
    until(lambda: blue_at(page, x + 144 + 20, 95) > 200)
    until(lambda: not follower.ring._holds)


def test_escape_gives_a_box_up(page: Any, follower: Follower) -> None:
    page.mouse.move(*place(page, 100, 80))
    page.mouse.down()
    page.mouse.move(*place(page, 140, 110))
    until(lambda: follower.ring._holds)
    page.keyboard.press("Escape")
    page.mouse.up()
    until(lambda: not follower.ring._holds)
    assert targets(follower) == []


def test_drawing_again_replaces_and_shift_or_the_button_adds(page: Any, follower: Follower) -> None:
    drag(page, BLOB)
    until(lambda: targets(follower) == [1])
    page.wait_for_selector("#targets li[data-id='1']")
    drag(page, (95, 75, 50, 40))
    until(lambda: targets(follower) == [2])
    page.wait_for_selector("#targets li[data-id='2']")
    page.keyboard.down("Shift")
    drag(page, BLOB)
    page.keyboard.up("Shift")
    until(lambda: targets(follower) == [2, 3])
    page.wait_for_selector("#targets li[data-id='3']")
    page.click("#add")
    assert page.get_attribute("#add", "aria-pressed") == "true"
    drag(page, BLOB)
    until(lambda: targets(follower) == [2, 3, 4])
    page.wait_for_selector("#add[aria-pressed=false]")
    # the one that is chosen is replaced, not the newest
    page.click("#targets li[data-id='3'] .pick")
    page.wait_for_selector("#targets li[data-id='3'].selected")
    drag(page, BLOB)
    until(lambda: targets(follower) == [2, 4, 5])


def test_everything_can_be_done_with_keys(page: Any, follower: Follower, stream: Stream) -> None:
    # near the middle, where the box of the keys begins
    blob = (290.0, 215.0, 60.0, 50.0)
    stream.blobs = [blob]
    page.focus("#picture")
    page.keyboard.press("b")
    assert "Arrows move the box" in page.inner_text("#live")

    def box() -> list[int]:
        return [int(v) for v in page.inner_text("#live").partition("Box ")[2].split(", ")]

    def press(wanted: int, now: Callable[[], int], less: str, more: str) -> None:
        while (value := now()) != wanted:
            key = less if value > wanted else more
            page.keyboard.press(key if abs(value - wanted) > 8 else f"Control+{key}")

    # sized first, since its left and upper edges stay
    press(60, lambda: box()[2], "Shift+ArrowLeft", "Shift+ArrowRight")
    press(50, lambda: box()[3], "Shift+ArrowUp", "Shift+ArrowDown")
    press(290, lambda: box()[0], "ArrowLeft", "ArrowRight")
    press(215, lambda: box()[1], "ArrowUp", "ArrowDown")
    page.keyboard.press("Enter")
    until(lambda: targets(follower) == [1])
    until(lambda: centre_error(follower.newest.tracks[1].box, blob) < 2)  # type: ignore[union-attr]
    page.wait_for_selector("#targets li[data-id='1']")
    page.keyboard.press("b")
    page.keyboard.press("Escape")
    page.keyboard.press("a")
    page.wait_for_selector("#add[aria-pressed=true]")
    drag(page, blob)
    until(lambda: targets(follower) == [1, 2])
    page.wait_for_selector("#targets li[data-id='2'].selected")
    page.keyboard.press("1")
    page.wait_for_selector("#targets li[data-id='1'].selected")
    page.keyboard.press("Delete")
    until(lambda: targets(follower) == [2])
    page.wait_for_selector("#targets li[data-id='1']", state="detached")
    page.keyboard.press("x")
    until(lambda: targets(follower) == [])
    page.keyboard.press("c")
    page.wait_for_selector("#role", state="hidden")
    page.keyboard.press("?")
    page.wait_for_selector("#help[open]")
    # what is meant for the dialog does nothing behind it
    page.keyboard.press("b")
    page.keyboard.press("Escape")
    page.wait_for_selector("#help", state="hidden")
    assert not page.evaluate("document.querySelector('#hint').textContent.includes('Arrows')")


def test_a_tap_on_nothing_says_so(page: Any, follower: Follower, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.control.find_box", lambda *_: None)
    page.mouse.click(*place(page, 400, 300))
    page.wait_for_selector("#banner:visible:has-text('nothing to follow was found there')")
    assert page.get_attribute("#banner", "role") == "status"
    until(lambda: not follower.ring._holds)
    assert targets(follower) == []


def test_another_viewer_asks_for_control_and_is_given_it(page: Any, visit: Callable[..., Any], address: str) -> None:
    page.click("#operator")
    page.wait_for_selector("#role:has-text('you control')")
    other = visit(address)
    other.wait_for_selector("#why:visible")
    assert other.get_attribute("#operator", "aria-describedby") == "why"
    assert "when they hand over, or 15 s after they leave" in other.inner_text("#why")
    other.click("#operator:has-text('Ask for control')")
    other.wait_for_selector("#banner:has-text('it was asked to hand over')")
    page.wait_for_selector("#role:has-text('you are asked to hand over')")
    page.wait_for_selector("#banner[role=status]:has-text('Another viewer asks for control')")
    assert other.is_disabled("#stop")
    page.keyboard.press("c")
    other.wait_for_selector("#role:has-text('you control')")
    other.wait_for_selector("#why", state="hidden")
    page.wait_for_selector("#role:has-text('another controls')")


def test_a_sound_is_heard_when_a_target_is_lost_if_it_was_asked_for(
    page: Any, follower: Follower, stream: Stream
) -> None:
    page.evaluate(
        "() => { window.AudioContext = class { currentTime = 0; destination = {};"
        " createGain() { return { gain: {}, connect: (to) => to }; }"
        " createOscillator() { window.tones = (window.tones ?? 0) + 1;"
        " return { frequency: { setValueAtTime() {} }, connect: (to) => to, start() {}, stop() {} }; } }; }"
    )
    follower.add(BLOB)
    page.wait_for_selector("#targets .state.tracking")
    page.click("#sound")
    # once, so that the operator knows it and the browser allows it
    assert page.get_attribute("#sound", "aria-pressed") == "true"
    assert page.evaluate("window.tones") == 1
    stream.blobs = [None]  # type: ignore[list-item]  # the ground alone
    page.wait_for_selector("#targets .state.lost")
    assert page.evaluate("window.tones") == 2
    page.keyboard.press("m")
    assert page.get_attribute("#sound", "aria-pressed") == "false"
    assert page.evaluate("window.tones") == 2


def test_figures_are_dashes_until_there_is_something_to_tell(page: Any, follower: Follower) -> None:
    assert page.inner_text("#latency") == page.inner_text("#tracker") == "\u2013"
    follower.add(BLOB)
    until(lambda: page.inner_text("#latency") != "\u2013")
    # read in one go, since they change with every frame
    read = "['tracker', 'latency'].map((name) => +document.getElementById(name).textContent)"
    tracker, latency = page.evaluate(read)
    assert 0 < tracker <= latency
    follower.clear()
    until(lambda: page.inner_text("#latency") == page.inner_text("#tracker") == "\u2013")


CONTRAST = """() => {
  const parse = (text) => { const v = text.match(/[\\d.]+/g).map(Number); return [...v.slice(0, 3), v[3] ?? 1]; };
  const over = (top, below) => [0, 1, 2].map((i) => top[i] * top[3] + below[i] * (1 - top[3])).concat(1);
  const ground = (place) => {
    const chain = [];
    for (let each = place; each; each = each.parentElement) chain.unshift(each);
    const colours = chain.map((each) => parse(getComputedStyle(each).backgroundColor));
    return colours.reduce((below, top) => over(top, below), [255, 255, 255, 1]);
  };
  const light = (colour) => colour.slice(0, 3).map((v) => v / 255)
    .map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const found = [];
  for (const place of document.querySelectorAll("body *")) {
    const own = [...place.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
    if (!own || !place.checkVisibility() || place.closest(".unseen")) continue;
    const below = ground(place);
    const [a, b] = [light(over(parse(getComputedStyle(place).color), below)), light(below)].sort((p, q) => q - p);
    found.push([(a + 0.05) / (b + 0.05), place.id || place.className || place.tagName, place.textContent.slice(0, 20)]);
  }
  return found;
}"""


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_all_text_can_be_read(visit: Callable[..., Any], address: str, follower: Follower, theme: str) -> None:
    page = visit(address)
    page.wait_for_selector(LIVE)
    while page.evaluate("document.documentElement.dataset.theme") != theme:
        page.click("#theme")
    follower.add(BLOB)
    page.wait_for_selector("#targets .state")
    page.evaluate("for (const place of document.querySelectorAll('[hidden], dialog')) { place.hidden = false; }")
    for state in ("tracking", "unsure", "lost"):
        page.evaluate(f"document.querySelector('#targets .state').className = 'state {state}'")
        found = page.evaluate(CONTRAST)
        assert len(found) > 20
        assert [each for each in found if each[0] < 4.5] == []
    page.click("#help-open")
    found = [each for each in page.evaluate(CONTRAST) if each[1] in ("DT", "DD")]
    assert len(found) >= 10
    assert [each for each in found if each[0] < 4.5] == []


def test_a_theme_is_remembered(page: Any) -> None:
    before = page.evaluate("document.documentElement.dataset.theme")
    page.click("#theme")
    page.reload()
    page.wait_for_selector(LIVE)
    assert page.evaluate("document.documentElement.dataset.theme") != before


def test_everything_has_a_name_of_its_own(page: Any, follower: Follower) -> None:
    for _ in range(2):
        follower.add(BLOB)
    page.wait_for_selector("#targets li:nth-child(2)")
    names = page.evaluate(
        "[...document.querySelectorAll('button, input, canvas, summary')].filter((each) => each.checkVisibility())"
        ".map((each) => each.getAttribute('aria-label') || each.textContent.trim())"
    )
    assert len(names) > 12
    assert all(names)
    assert len(set(names)) == len(names)
    assert page.get_attribute("#events", "aria-live") == "polite"
    assert page.get_attribute("#live", "aria-live") == "polite"


@pytest.fixture
def recording(follower: Follower, tmp_path: Path) -> Iterator[str]:
    """A server that records."""
    pytest.importorskip("av")
    recorder = Recorder(tmp_path / "recordings", follower)
    with served(Control(follower, recorder)) as address:
        yield address
        recorder.stop()


def test_recordings_and_snapshots_are_fetched(visit: Callable[..., Any], recording: str, tmp_path: Path) -> None:
    page = visit(recording)
    page.wait_for_selector(LIVE)
    page.click("#record")
    page.wait_for_selector("#rec:visible")
    page.click("#record")
    page.wait_for_selector("#rec", state="hidden")
    page.click("#recorded summary")
    page.wait_for_selector("#recordings a")
    with page.expect_download() as fetched:
        page.click("#recordings a:has-text('video.mkv')")
    (folder,) = (tmp_path / "recordings").iterdir()
    assert Path(fetched.value.path()).read_bytes() == (folder / "video.mkv").read_bytes()
    page.focus("#picture")
    with page.expect_download() as fetched:
        page.keyboard.press("s")
    assert fetched.value.suggested_filename.endswith(".jpg")
    assert cv2.imread(str(fetched.value.path())).shape == (HEIGHT, WIDTH, 3)


@pytest.fixture
def played(tmp_path: Path, blob_frame: Callable[..., Any], blob_engine: Any) -> Iterator[str]:
    """A server of a folder of images."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for number in range(90):
        cv2.imwrite(str(folder / f"{number}.png"), blob_frame((20 + 3 * number, 80, 40, 30)))
    with Follower(lambda tell: open_source(folder, on_event=tell), TargetPool()) as running:
        until(lambda: running.newest)
        with served(Control(running)) as address:
            yield address


def test_a_file_is_paused_and_wound(visit: Callable[..., Any], played: str) -> None:
    page = visit(played)
    page.wait_for_selector("#pause:has-text('Pause')")
    page.click("#pause")
    page.wait_for_selector("#pause:has-text('Play')")
    assert page.inner_text("#link") == "paused"
    assert page.inner_text("#fps") == "\u2013"
    assert page.inner_text("#source") == "frames \u00b7 320\u00d7240"
    page.focus("#slider")
    page.keyboard.press("Home")
    until(lambda: blue_at(page, 30, 95) > 200)
    page.focus("#picture")
    with httpx.Client(base_url=f"http://{played}", timeout=60) as http:
        for key, frame in ((".", 1), (".", 2), (",", 1)):
            page.keyboard.press(key)
            until(lambda frame=frame: http.get("/api/state").json()["source"]["frame"] == frame)
            until(lambda frame=frame: page.input_value("#slider") == str(frame))
    # a box that is drawn meanwhile is shown, though no frame comes
    drag(page, (23, 80, 40, 30))
    page.wait_for_selector("#targets .state.tracking")
    until(lambda: green(page, 43, 80))
    page.keyboard.press("p")
    page.wait_for_selector("#pause:has-text('Pause')")


def test_a_camera_has_nothing_to_wind(page: Any) -> None:
    assert not page.is_visible("#time")
