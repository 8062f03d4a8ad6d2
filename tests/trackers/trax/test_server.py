from __future__ import annotations

import io
import json
import os
import shlex
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, Image
from psiamfcpp.trackers.adapters.trax_worker import Message, join_message, split_message
from psiamfcpp.trackers.contract import Track
from psiamfcpp.trackers.trax import open_trax, serve_trax

REFERENCE = Path(__file__).with_name("reference_client.py")

# Serves a tracker whose box is the first pixel of the frame: blue, green, red, and the frame's number.
PIXEL_SERVER = """
from psiamfcpp.trackers.contract import Track
from psiamfcpp.trackers.trax import serve_trax
class Pixel:
    def init(self, frame, box):
        self.count = 0
        print("noise on standard output")
        return Track(tuple(float(v) for v in box), 1.0, "tracking")
    def update(self, frame):
        self.count += 1
        return Track((*(float(v) for v in frame[0, 0]), self.count), 0.5, "unsure")
serve_trax(Pixel(), "pixel")
"""


class Recorder:
    """A tracker that keeps what it is given and moves its box by one pixel per frame."""

    def __init__(self) -> None:
        self.frames: list[Image] = []
        self.boxes: list[Box] = []

    def init(self, frame: Image, box: Any) -> Track:
        self.frames.append(frame)
        self.boxes.append(box)
        self.box = box
        return Track(box)

    def update(self, frame: Image) -> Track:
        self.frames.append(frame)
        x, y, w, h = self.box
        self.box = (x + 1, y, w, h)
        return Track(self.box, 0.75, "tracking")


def converse(tracker: Any, lines: list[bytes]) -> list[Message]:
    sink = io.BytesIO()
    serve_trax(tracker, "mine", (io.BytesIO(b"".join(lines)), sink))
    return replies(sink)


def replies(sink: io.BytesIO) -> list[Message]:
    messages = [split_message(line) for line in sink.getvalue().splitlines()]
    assert None not in messages
    return [message for message in messages if message]


@pytest.fixture
def frame_files(tmp_path: Path) -> list[Path]:
    paths = []
    for number in range(3):
        frame = np.full((50, 60, 3), 40, np.uint8)
        frame[0, 0] = (100 + number, 50, 10)
        paths.append(tmp_path / f"frame {number}.png")
        cv2.imwrite(str(paths[-1]), frame)
    return paths


def test_hello_says_what_is_understood() -> None:
    (hello,) = converse(Recorder(), [])
    assert hello.kind == "hello"
    assert hello.properties["trax.version"] == "4"
    assert hello.properties["trax.name"] == "mine"
    assert hello.properties["trax.region"] == "rectangle;"
    assert set(hello.properties["trax.image"].strip(";").split(";")) == {"path", "url", "memory", "data", "buffer"}


@pytest.mark.parametrize("version", [3, 4])
def test_follows_a_target_and_then_another(frame_files: list[Path], version: int) -> None:
    paths = [f"file://{path}" for path in frame_files]
    starts = []
    for region in ("10,20,30,40", "1,2,3,4"):
        if version == 3:
            starts.append([join_message("initialize", [paths[0], region])])
        else:
            starts.append([join_message("initialize", [region]), join_message("frame", [paths[0]])])
    follow = [join_message("frame", [path]) for path in paths[1:]]
    reset = [join_message("initialize")] if version == 4 else []
    tracker = Recorder()
    _, *states = converse(tracker, [*starts[0], *follow, *reset, *starts[1], *follow, join_message("quit")])
    assert [state.arguments[0] for state in states] == [
        "10.0,20.0,30.0,40.0", "11.0,20.0,30.0,40.0", "12.0,20.0,30.0,40.0",
        "1.0,2.0,3.0,4.0", "2.0,2.0,3.0,4.0", "3.0,2.0,3.0,4.0",
    ]  # fmt: skip
    assert states[0].properties == {}
    assert states[1].properties == {"confidence": "0.75", "state": "tracking"}
    assert [frame[0, 0, 0] for frame in tracker.frames] == [100, 101, 102] * 2


@pytest.mark.parametrize(
    ("region", "box"),
    [
        ("1.5,2,3,4.25", (1.5, 2, 3, 4.25)),
        ("1,1,5,1,4,4.25", (1, 1, 4, 3.25)),
        # 12 by 10, of which rows 2 to 4 have columns 3 to 6, and row 5 column 4; written by the reference library
        ("mask:0,0,12,10,27,4,8,4,8,4,9,1", (3, 2, 4, 4)),
        ("mask:20,30,2,2,0,4", (20, 30, 2, 2)),
    ],
)
def test_regions_of_all_kinds(frame_files: list[Path], region: str, box: Box) -> None:
    tracker = Recorder()
    converse(tracker, [join_message("initialize", [region]), join_message("frame", [str(frame_files[0])])])
    assert tracker.boxes == [box]


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        ([join_message("frame", ["file:///a.png"])], "frame before initialize"),
        ([join_message("initialize", ["1,2,3,4"])] * 2, "second target"),
        ([join_message("initialize", ["1,2,3,4"]), join_message("frame", [])], "frame has 0 images"),
        ([join_message("initialize", ["1,2,3,4"]), join_message("frame", ["a", "b"])], "frame has 2 images"),
        ([join_message("initialize", ["1,2,3,4"]), join_message("frame", ["file:///absent"])], "does not exist"),
        ([join_message("initialize", ["1,2,3"]), join_message("frame", ["FRAME"])], "has 3 numbers"),
        ([join_message("initialize", ["0"]), join_message("frame", ["FRAME"])], "no place to start from"),
        ([join_message("initialize", ["mask:0,0,2,2,4"]), join_message("frame", ["FRAME"])], "empty mask"),
        ([join_message("initialize", ["mask:0,0,2,2,0,5"]), join_message("frame", ["FRAME"])], "more pixels"),
        ([join_message("initialize", ["1", "2", "3"])], "initialize has 3 arguments"),
        ([join_message("hello")], "not one for a tracker"),
        ([b"@@TRAX:\n"], "has no name"),
    ],
)
def test_a_client_that_breaks_the_protocol_is_sent_away(
    frame_files: list[Path], lines: list[bytes], reason: str
) -> None:
    lines = [line.replace(b"FRAME", bytes(frame_files[0])) for line in lines]
    sink = io.BytesIO()
    with pytest.raises(UserError, match="the TraX client broke the protocol: .*" + reason):
        serve_trax(Recorder(), "mine", (io.BytesIO(b"".join(lines)), sink))
    _, last = replies(sink)
    assert last.kind == "quit"
    assert reason in last.properties["trax.reason"]


def test_a_fault_of_the_tracker_ends_the_conversation_with_its_reason(frame_files: list[Path]) -> None:
    class Refuses(Recorder):
        def init(self, frame: Image, box: Any) -> Track:
            raise UserError("box 1,2,3,4 lies outside the frame")

    sink = io.BytesIO()
    lines = join_message("initialize", ["1,2,3,4"]) + join_message("frame", [str(frame_files[0])])
    with pytest.raises(UserError, match="outside the frame"):
        serve_trax(Refuses(), "mine", (io.BytesIO(lines), sink))
    assert replies(sink)[-1].properties["trax.reason"] == "box 1,2,3,4 lies outside the frame"


@pytest.mark.slow
def test_our_client_and_our_server_agree_to_the_last_digit() -> None:
    tracker = open_trax(shlex.join([sys.executable, "-c", PIXEL_SERVER]))
    frame = np.full((60, 80, 3), 7, np.uint8)
    frame[0, 0] = (1, 2, 3)
    try:
        box = (10 + 1 / 3, 20.0, 30.0, 40.0 / 7)
        track = tracker.init(frame, box)
        assert (track.box, track.score, track.state) == (box, 1.0, "tracking")
        track = tracker.update(frame)
        assert (track.box, track.score, track.state) == ((1, 2, 3, 1), 0.5, "unsure")
    finally:
        tracker.close()


@pytest.mark.slow
def test_speaks_over_the_port_that_the_client_names() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = str(listener.getsockname()[1])
        server = subprocess.Popen(
            [sys.executable, "-c", PIXEL_SERVER], env={**os.environ, "TRAX_SOCKET": port}, stdin=subprocess.DEVNULL
        )
        try:
            listener.settimeout(300)
            connection, _ = listener.accept()
            with connection, connection.makefile("rwb", buffering=0) as stream:
                hello = split_message(stream.readline())
                assert hello is not None and hello.properties["trax.name"] == "pixel"
                stream.write(join_message("quit"))
                assert stream.readline() == b""
            assert server.wait(300) == 0
        finally:
            server.kill()


@pytest.mark.slow
def test_urls_are_fetched(frame_files: list[Path]) -> None:
    from http.server import BaseHTTPRequestHandler, HTTPServer

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if "frame" in self.path else 404)
            self.end_headers()
            self.wfile.write(frame_files[0].read_bytes())

        def log_message(self, *args: Any) -> None:
            return

    server = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        address = f"http://127.0.0.1:{server.server_port}"
        tracker = Recorder()
        start = join_message("initialize", ["1,2,3,4"])
        converse(tracker, [start, join_message("frame", [f"{address}/frame.png"])])
        assert tracker.frames[0][0, 0].tolist() == [100, 50, 10]
        with pytest.raises(UserError, match="cannot be read"):
            converse(tracker, [start, join_message("frame", [f"{address}/absent.png"])])
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["path", "url", "memory", "buffer"])
def test_the_reference_client_is_served(frame_files: list[Path], kind: str) -> None:
    pytest.importorskip("trax", reason="vot-trax, the independent TraX client, is not installed")
    command = [sys.executable, str(REFERENCE), kind, *map(str, frame_files), "--", sys.executable, "-c", PIXEL_SERVER]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["name"], found["status"]) == ("pixel", 0)
    follow = [[[100 + n, 50, 10, n], {"confidence": "0.5", "state": "unsure"}] for n in (1, 2)]
    first = {"confidence": "1.0", "state": "tracking"}
    assert found["targets"] == [[[[10, 20, 30, 40], first], *follow], [[[5, 6, 7, 8], first], *follow]]


@pytest.mark.slow
def test_the_reference_server_is_understood() -> None:
    pytest.importorskip("trax", reason="vot-trax, the independent TraX server, is not installed")
    script = """
import trax
server = trax.Server(["rectangle"], ["memory", "path"], tracker_name="reference")
while True:
    request = server.wait()
    if request.type not in ("initialize", "frame"):
        break
    if request.type == "initialize":
        x, y, w, h = request.objects[0][0].bounds()
    red, green, blue = request.image["color"].array()[0, 0]
    server.status([(trax.Rectangle.create(float(red), float(green), float(blue), h), {"confidence": 0.5})])
"""
    tracker = open_trax(shlex.join([sys.executable, "-c", script]))
    frame = np.full((60, 80, 3), 7, np.uint8)
    frame[0, 0] = (30, 20, 10)
    try:
        for height in (11.0, 12.5):
            tracker.init(frame, (5.0, 6.0, 7.0, height))
            track = tracker.update(frame)
            assert (track.box, track.score) == ((10, 20, 30, height), 0.5)
    finally:
        tracker.close()


@pytest.mark.slow
def test_the_command_serves_a_model(tiny_model: Path, blob_frame: Callable[..., Image]) -> None:
    from psiamfcpp import Tracker

    words = [sys.executable, "-m", "psiamfcpp", "trax", "--model", str(tiny_model), "--plain", "--threads", "1"]
    served, direct = open_trax(shlex.join(words)), Tracker(str(tiny_model), threads=1, plain=True)
    try:
        frames = [blob_frame((100 + 3 * n, 80, 40, 30)) for n in range(3)]
        served.init(frames[0], (100, 80, 40, 30))
        direct.init(frames[0], (100, 80, 40, 30))
        for frame in frames[1:]:
            ours, theirs = direct.update(frame), served.update(frame)
            assert theirs.box == ours.box
            assert theirs.score == ours.score
    finally:
        served.close()
