"""Sources: every kind yields its frames, and what is broken says so."""

from __future__ import annotations

import http.server
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.video import live
from psiamfcpp.video.capture import ended_early, has_gstreamer
from psiamfcpp.video.source import Image, Source, open_source
from psiamfcpp.video.writer import VideoWriter

TIMEOUT_S = 120.0


def grey(level: int, width: int = 64, height: int = 48) -> Image:
    return np.full((height, width, 3), level, np.uint8)


def levels(source: Source) -> list[int]:
    return [round(float(frame.mean())) for frame in source]


def write_video(path: Path, count: int = 20, noise: bool = False) -> Path:
    rng = np.random.default_rng(0)
    with VideoWriter(path, 20, (64, 48)) as writer:
        for i in range(count):
            writer.write(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8) if noise else grey(10 * i))
    return path


def write_images(folder: Path, names: list[str]) -> Path:
    folder.mkdir(exist_ok=True)
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / name), grey(10 * (i + 1)))
    return folder


@pytest.fixture(autouse=True)
def no_thread_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    assert [t for t in threading.enumerate() if t not in before and t.name.startswith("frames of ")] == []


# files and folders


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi"])
def test_a_video_yields_every_frame_in_order(tmp_path: Path, suffix: str) -> None:
    with open_source(write_video(tmp_path / f"a{suffix}")) as source:
        assert (source.fps, source.frame_count, source.live) == (20, 20, False)
        assert np.allclose(levels(source), np.arange(20) * 10, atol=5)


def test_a_name_with_a_colon_or_brackets_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "12:30 [a].mp4", 5)
    monkeypatch.chdir(tmp_path)
    with open_source("12:30 [a].mp4") as source:
        assert len(levels(source)) == 5


def test_frames_are_not_overwritten_by_later_ones(tmp_path: Path) -> None:
    with open_source(write_video(tmp_path / "a.mp4", 5)) as source:
        assert len({float(frame.mean()) for frame in list(source)}) == 5


def test_a_folder_is_read_in_counting_order(tmp_path: Path) -> None:
    write_images(tmp_path / "f", ["1.png", "2.png", "10.png"])
    (tmp_path / "f" / "notes.txt").write_text("no image")
    (tmp_path / "f" / "._1.png").write_text("no image")
    with open_source(tmp_path / "f") as source:
        assert (source.fps, source.frame_count, source.live) == (30, 3, False)
        assert levels(source) == [10, 20, 30]


@pytest.mark.parametrize("pattern", ["f/*.png", "**/*.png", "f/[12].png"])
def test_a_glob_yields_what_it_matches(tmp_path: Path, pattern: str) -> None:
    write_images(tmp_path / "f", ["1.png", "2.png", "10.bmp"])
    with open_source(str(tmp_path / pattern), fps=12) as source:
        assert source.fps == 12
        assert levels(source) == [10, 20]


def test_one_image_is_a_clip_of_one_frame(tmp_path: Path) -> None:
    folder = write_images(tmp_path, ["img_001.png", "img_002.png"])
    with open_source(folder / "img_001.png") as source:
        assert levels(source) == [10]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.mp4", None, "does not exist"),
        ("none/*.jpg", None, "matches no image"),
        ("empty.mp4", b"", "not a video"),
        ("text.mp4", b"hello\n" * 900, "not a video"),
        ("notes.txt", b"hello\n" * 900, "not a video"),
        ("folder/", None, "holds no image"),
    ],
)
def test_what_is_no_source_is_named(tmp_path: Path, name: str, content: bytes | None, message: str) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    elif name.endswith("/"):
        path.mkdir()
    with pytest.raises(UserError, match=message) as caught:
        open_source(str(path))
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name",
    [
        os.fsdecode(b"\xff\xfe.mp4"),
        os.fsdecode(b"/tmp/\xff/a.mp4"),
        "rtsp://host/\udcff",
        "a\0b.mp4",
        "",
        "x" * 5000,
        "x" * 300 + "/a.mp4",
        "~nobody-of-that-name/a.mp4",
        "9" * 30,
        "9" * 5000,
        "10000",
        -1,
        10**30,
    ],
)
def test_names_that_would_crash_a_library_are_refused_in_one_line(name: str | int) -> None:
    with pytest.raises(UserError) as caught:
        open_source(name)
    assert "\n" not in str(caught.value)


def test_files_whose_names_are_not_utf8_are_refused(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"\xff\xfe.mp4")
    path.write_bytes(write_video(tmp_path / "a.mp4", 3).read_bytes())
    with pytest.raises(UserError, match="rename it"):
        open_source(path)
    with pytest.raises(UserError, match="rename it"):
        VideoWriter(path, 25, (64, 48))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
@pytest.mark.parametrize("suffix", [".mp4", ".png"])
def test_a_pipe_is_no_source_and_no_output(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"pipe{suffix}"
    os.mkfifo(path)
    with pytest.raises(UserError, match="is a pipe or a device"):
        open_source(path)
    if suffix == ".mp4":
        with pytest.raises(UserError, match="cannot be written: it is a pipe or a device"):
            VideoWriter(path, 25, (64, 48))


def test_images_of_more_than_8_bits_keep_one_scale(tmp_path: Path) -> None:
    for number, low in enumerate((7000, 7100)):
        frame = np.full((48, 64), low, np.uint16)
        frame[10:30, 10:30] = 7800
        cv2.imwrite(str(tmp_path / f"{number}.png"), frame)
    with open_source(tmp_path) as source:
        first, second = source
    assert (first[0, 0, 0], first[20, 20, 0]) == (0, 255)
    assert (second[0, 0, 0], second[20, 20, 0]) == (32, 255)


@pytest.mark.parametrize("suffix", [".mkv", ".avi"])
def test_a_truncated_video_yields_its_start_then_says_so(tmp_path: Path, suffix: str) -> None:
    whole = write_video(tmp_path / f"a{suffix}", 60, noise=True).read_bytes()
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(whole[: len(whole) // 2])
    got = 0
    with open_source(cut) as source, pytest.raises(UserError, match=r"cut off: (\d+) of 60 frames") as caught:
        for _ in source:
            got += 1
    assert 10 < got < 50
    assert f" {got} of 60" in str(caught.value)


@pytest.mark.parametrize(
    ("read", "position_s", "count", "fps", "early"),
    [
        (100, 3.3, 100, 30.0, False),
        (98, 3.2, 100, 30.0, False),
        (97, 3.2, 100, 30.0, True),
        (990, 32.9, 1000, 30.0, False),
        (989, 32.9, 1000, 30.0, True),
        (60, 9.97, 300, 30.0, False),  # frames at a varying rate: few, but they reach the end
        (60, 2.0, 300, 30.0, True),
        (60, 2.0, None, 30.0, False),
        (60, 0.0, 300, None, True),
    ],
)
def test_only_a_real_gap_counts_as_cut_off(
    read: int, position_s: float, count: int | None, fps: float | None, early: bool
) -> None:
    assert ended_early(read, position_s, count, fps) is early


def test_an_unreadable_image_is_named_after_those_before_it(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "f", ["1.png", "2.png", "3.png"])
    (folder / "2.png").write_bytes(b"broken")
    with open_source(folder) as source:
        assert next(source).mean() == 10
        with pytest.raises(UserError, match=r"2\.png cannot be read"):
            next(source)


def test_an_image_of_another_size_is_named(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "f", ["1.png", "3.png"])
    cv2.imwrite(str(folder / "2.png"), grey(9, 32, 48))
    with open_source(folder) as source, pytest.raises(UserError, match=r"2\.png is 32x48, .* 64x48"):
        list(source)


def test_a_closed_source_ends(tmp_path: Path) -> None:
    source = open_source(write_video(tmp_path / "a.mp4", 5))
    next(source)
    source.close()
    source.close()
    assert list(source) == []


# live sources, on a device that does what the test says


class FakeDevice:
    """Stands in for OpenCV's capture: one script of frames an opening; None is an opening that fails.

    So many reads are answered at once as it is given turns; the others wait until a test lets them go on.
    """

    def __init__(self, scripts: list[list[Image] | None], turns: int = 1000, **properties: float) -> None:
        self._scripts, self.properties = scripts, properties
        self._given, self._turns = turns, threading.Semaphore(turns)
        self.opened = self.released = self._asked = 0

    def __call__(self, target: int | str, timeout_s: float | None) -> FakeCapture:
        script = self._scripts.pop(0) if self._scripts else None
        self.opened += script is not None
        return FakeCapture(self, script)

    def turn(self) -> None:
        """Wait for leave to give a frame."""
        self._asked += 1
        assert self._turns.acquire(timeout=TIMEOUT_S)

    def let(self, count: int) -> None:
        """Answer so many reads, and wait until their frames are there."""
        self._given += count
        self._turns.release(count)
        end = time.monotonic() + TIMEOUT_S
        # the next read is only asked for when the frame before is there
        while self._asked <= self._given:
            assert time.monotonic() < end
            time.sleep(0.001)

    def end(self) -> None:
        """Let all reads go on, since closing waits for the last of them."""
        self._turns.release(1000)


class FakeCapture:
    def __init__(self, device: FakeDevice, script: list[Image] | None) -> None:
        self._device, self._open, self._frames = device, script is not None, iter(script or [])

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        return self._open

    def get(self, prop: int) -> float:
        names = {cv2.CAP_PROP_FPS: "fps", cv2.CAP_PROP_FRAME_COUNT: "count"}
        return self._device.properties.get(names[prop], -1.0)

    def read(self) -> tuple[bool, Image | None]:
        self._device.turn()
        frame = next(self._frames, None)
        return frame is not None, frame

    def release(self) -> None:
        self._device.released += self._open
        self._open = False


def script(first: int, last: int) -> list[Image]:
    return [grey(i) for i in range(first, last)]


def plug(monkeypatch: pytest.MonkeyPatch, device: FakeDevice) -> FakeDevice:
    monkeypatch.setattr(live, "open_capture", device)
    return device


def test_a_slow_reader_gets_the_newest_frame_and_none_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    device = plug(monkeypatch, FakeDevice([script(0, 200)], turns=1, fps=90000.0))
    seen = []
    with open_source("0") as source:
        assert (source.live, source.frame_count, source.fps) == (True, None, 30)
        for later in (20, 20, 1, 0):
            seen.append(int(next(source)[0, 0, 0]))
            if later:
                device.let(later)
        device.end()
    assert seen == [0, 20, 40, 41]
    assert device.opened == device.released == 1


def test_a_fast_reader_waits_and_gets_each_frame_once(monkeypatch: pytest.MonkeyPatch) -> None:
    device = plug(monkeypatch, FakeDevice([script(0, 12)], turns=1))
    seen = []
    with open_source(0, reconnect_s=0.1) as source:
        for number in range(12):
            seen.append(int(next(source)[0, 0, 0]))
            if number < 11:
                device.let(1)
        device.end()
        with pytest.raises(UserError, match="did not come back"):
            next(source)
    assert seen == list(range(12))


@pytest.mark.slow
def test_a_stream_that_comes_back_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    # four frames and their end, an opening without a frame, ten frames: then it waits
    device = plug(monkeypatch, FakeDevice([script(0, 4), None, [], script(50, 60)], turns=5 + 1 + 10))
    events: list[str] = []
    with open_source("rtsp://me:secret@host/a", on_event=events.append, reconnect_s=TIMEOUT_S) as source:
        assert source.name == "stream rtsp://me:***@host/a"
        for frame in source:
            if frame[0, 0, 0] == 59:
                break
        device.end()
    assert len(events) == 2
    assert "stopped after 4 frames" in events[0]
    assert "is back after" in events[1]
    assert not any("secret" in event for event in events)
    assert device.opened == device.released == 3


def test_a_file_behind_an_address_is_paced_by_its_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []

    class Stop(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            waits.append(timeout or 0.0)
            return self.is_set()

    plug(monkeypatch, FakeDevice([script(0, 8)], fps=20.0, count=8.0))
    monkeypatch.setattr(live, "threading", SimpleNamespace(**{**vars(threading), "Event": Stop}))
    monkeypatch.setattr(live, "time", SimpleNamespace(monotonic=lambda: 100.0))
    with open_source("http://host/a.mp4") as source:
        assert levels(source)[-1] == 7
    assert waits == pytest.approx([k / 20 for k in range(1, 8)])


@pytest.mark.slow
def test_a_stream_that_stays_away_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    device = plug(monkeypatch, FakeDevice([script(0, 4)]))
    message = r"stream rtsp://host/a stopped after 4 frames and did not come back within 0\.6 s: "
    with open_source("rtsp://host/a", reconnect_s=0.6) as source, pytest.raises(UserError, match=message):
        list(source)
    assert device.released == 1


def test_closing_ends_the_wait_for_a_lost_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    plug(monkeypatch, FakeDevice([script(0, 2)]))
    began = threading.Event()
    source = open_source("rtsp://host/a", on_event=lambda _: began.set(), reconnect_s=3600)
    next(source)
    reader = threading.Thread(target=lambda: list(source._frames))
    reader.start()
    assert began.wait(TIMEOUT_S)
    source.close()
    reader.join(TIMEOUT_S)
    assert not reader.is_alive()


def test_whatever_breaks_the_reader_reaches_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    def read(self: FakeCapture) -> tuple[bool, Image]:
        if threading.current_thread() is threading.main_thread():
            return True, grey(1)
        raise MemoryError("no room")

    monkeypatch.setattr(FakeCapture, "read", read)
    plug(monkeypatch, FakeDevice([[]]))
    with open_source(0) as source, pytest.raises(MemoryError):
        list(source)


# live sources, on real cameras and sockets


def test_a_camera_that_is_not_there_is_named() -> None:
    with pytest.raises(UserError, match="camera 97 cannot be opened"):
        open_source("97")


@pytest.mark.parametrize("scheme", ["http", "rtsp"])
@pytest.mark.parametrize("listens", [False, True])
def test_a_dead_or_mute_address_is_named_and_does_not_hang(scheme: str, listens: bool) -> None:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        if listens:
            server.listen()
        url = f"{scheme}://127.0.0.1:{server.getsockname()[1]}/a"
        with pytest.raises(UserError, match=f"stream {url} cannot be opened"):
            open_source(url, timeout_s=0.5)


@contextmanager
def served(handler: type[http.server.BaseHTTPRequestHandler]) -> Iterator[str]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.slow
def test_an_mjpeg_stream_is_read_and_brought_back() -> None:
    jpeg = cv2.imencode(".jpg", grey(120))[1].tobytes()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=b")
            self.end_headers()
            for _ in range(30):
                head = f"--b\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")
                time.sleep(0.005)

        def log_message(self, *args: object) -> None:
            pass

    events: list[str] = []
    with (
        served(Handler) as url,
        open_source(f"{url}/cam", on_event=events.append, reconnect_s=TIMEOUT_S, timeout_s=TIMEOUT_S) as source,
    ):
        for frame in source:
            assert frame.shape == (48, 64, 3)
            if len(events) >= 2:
                break
    assert "stopped after" in events[0]
    assert "is back" in events[1]


@pytest.mark.slow
def test_a_file_behind_an_address_plays_once(tmp_path: Path) -> None:
    data = write_video(tmp_path / "a.mkv", 20).read_bytes()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, *args: object) -> None:
            pass

    with served(Handler) as url, open_source(f"{url}/a.mkv", timeout_s=TIMEOUT_S) as source:
        seen = levels(source)
    assert source.live
    # whoever reads slowly misses some, but sees none twice and the last
    assert seen == sorted(set(seen))
    assert seen[-1] == pytest.approx(190, abs=5)


# streams of packets

SESSION = """v=0
o=- 0 0 IN IP4 127.0.0.1
s=test
c=IN IP4 127.0.0.1
t=0 0
m=video {port} RTP/AVP 96
a=rtpmap:96 H264/90000
"""


@contextmanager
def sent(address: str, container: str) -> Iterator[None]:
    """Send H.264 to an address until the block ends, a key frame every fifth."""
    av = pytest.importorskip("av")
    stop = threading.Event()

    def send() -> None:
        with av.open(f"{address}?pkt_size=1316", "w", format=container) as out:
            options = {"preset": "ultrafast", "tune": "zerolatency", "g": "5"}
            stream = out.add_stream("libx264", rate=25, options=options)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            number = 0
            while not stop.wait(0.02):
                frame = av.VideoFrame.from_ndarray(grey(100 + number % 100), format="bgr24")
                frame.pts, number = number, number + 1
                out.mux(stream.encode(frame))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@pytest.fixture
def port() -> int:
    """A port of this machine for packets."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


@pytest.mark.slow
def test_packets_of_a_drone_are_followed_live(port: int) -> None:
    address = f"udp://127.0.0.1:{port}"
    with sent(address, "mpegts"), open_source(address, timeout_s=TIMEOUT_S) as source:
        assert source.live
        frames = [next(source) for _ in range(3)]
    assert {frame.shape for frame in frames} == {(48, 64, 3)}
    assert all(95 < frame.mean() < 205 for frame in frames)


@pytest.mark.slow
def test_a_session_description_opens_its_ports(port: int, tmp_path: Path) -> None:
    path = tmp_path / "drone.sdp"
    path.write_text(SESSION.format(port=port))
    with sent(f"rtp://127.0.0.1:{port}", "rtp"), open_source(path, timeout_s=TIMEOUT_S) as source:
        assert (source.live, source.name) == (True, f"session {path}")
        assert next(source).shape == (48, 64, 3)
    assert "OPENCV_FFMPEG_CAPTURE_OPTIONS" not in os.environ


@pytest.mark.parametrize("scheme", ["udp", "srt", "rtmp", "tcp"])
def test_an_address_without_a_sender_is_no_file_name(scheme: str, port: int) -> None:
    with pytest.raises(UserError, match=rf"stream {scheme}://127\.0\.0\.1:{port} cannot be opened"):
        open_source(f"{scheme}://127.0.0.1:{port}", timeout_s=0.3)


def test_a_pipeline_needs_gstreamer() -> None:
    if has_gstreamer():
        with open_source("videotestsrc num-buffers=3 ! videoconvert ! appsink") as source:
            assert next(source).shape[2] == 3
    else:
        with pytest.raises(UserError, match="this OpenCV has no GStreamer"):
            open_source("videotestsrc ! appsink")
