"""`psiamfcpp serve`."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from psiamfcpp.cli.arguments import SourceName
from psiamfcpp.cli.output import notes, progress
from psiamfcpp.demo.clip import render
from psiamfcpp.errors import UserError
from psiamfcpp.trackers import TargetPool, TrackerOptions
from psiamfcpp.video.source import Source, open_source
from psiamfcpp.video.writer import VideoWriter
from psiamfcpp.zoo import DEFAULT_MODEL

TOKEN_VARIABLE = "PSIAMFCPP_TOKEN"
_DEMO_FRAMES, _DEMO_FPS, _DEMO_SIZE = 300, 30.0, (1280, 720)


def serve(
    source: SourceName,
    host: str = "127.0.0.1",
    port: int = 8000,
    token: str | None = None,
    mavlink: str | None = None,
    mavlink_system: int = 1,
    fov: float | None = None,
    record: Path | None = None,
    model: str = DEFAULT_MODEL,
    tracker: str | None = None,
    options: TrackerOptions = TrackerOptions(),  # noqa: B008 - frozen
) -> None:
    """Follow targets of a stream; draw their boxes in a browser, in a ground station or by program.

    Args:
        source: video file (played over and over), camera number, RTSP or HTTP address, folder or glob of images, or
            the word demo for a rendered clip.
        host: address to listen on; another than this machine's own needs a token.
        port: port to listen on.
        token: what clients must know; better given in the variable PSIAMFCPP_TOKEN, which other users cannot see.
        mavlink: udpout:HOST:PORT, udpin:HOST:PORT or serial:DEVICE[:BAUD], to be a MAVLink camera there.
        mavlink_system: MAVLink system of the vehicle.
        fov: horizontal field of view of the camera in degrees; with it, bearings are sent.
        record: folder for recordings, which clients begin and end.
        model: name of a shipped model, or a model file.
        tracker: any other tracker instead, as opencv:mil, dcf:kcf or module:pkg.mod:Class.
        options: how the model runs.
    """
    from psiamfcpp.serve import guard, server
    from psiamfcpp.serve.app import build_app
    from psiamfcpp.serve.control import Control
    from psiamfcpp.serve.follower import Follower
    from psiamfcpp.serve.recorder import Recorder

    token = token if token is not None else os.environ.get(TOKEN_VARIABLE)
    guard.check_address(host, token)
    if fov is not None and not 0 < fov < 180:
        raise UserError(f"fov is {fov:g}: give degrees between 0 and 180")
    with contextlib.ExitStack() as stack:
        # what fails at once comes before what takes time
        listener = server.bind(host, port)
        stack.callback(listener.close)
        link = None
        if mavlink is not None:
            from psiamfcpp.serve.mavlink import Camera, open_link

            link = open_link(mavlink)
            stack.callback(link.close)
        pool = TargetPool(tracker or model, options=options)
        stack.callback(pool.close)
        path = _render_demo(stack) if source == "demo" else source
        follower = Follower(_opener(path, source), pool)
        recorder = None if record is None else Recorder(record, follower)
        control = Control(follower, recorder)
        stack.enter_context(follower)
        if recorder is not None:
            stack.callback(recorder.stop)
        if link is not None:
            stream = source if source.lower().startswith(("rtsp://", "rtsps://")) else ""
            stack.enter_context(Camera(control, link, mavlink_system, fov, stream))
        address = f"[{host}]" if ":" in host else host
        url = f"http://{address}:{listener.getsockname()[1]}/"
        app = build_app(control, token=token, fov=fov)
        server.run(server.make_server(app, lambda: notes.print(f"serving {url}")), listener, follower)


def _opener(path: str, source: str) -> Callable[[Callable[[str], None]], Source]:
    def opened(notify: Callable[[str], None]) -> Source:
        video = open_source(path, on_event=notify, reconnect_s=math.inf)
        # the path of the rendered demo says nothing to anybody
        return dataclasses.replace(video, name=source) if path != source else video

    return opened


def _render_demo(stack: contextlib.ExitStack) -> str:
    """The demo clip as a file that lives as long as the stack."""
    path = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="psiamfcpp-"))) / "demo.mp4"
    with progress() as bar, VideoWriter(path, _DEMO_FPS, _DEMO_SIZE) as video:
        task = bar.add_task("rendering the demo", total=_DEMO_FRAMES)
        for shot in render(0, _DEMO_FRAMES, _DEMO_SIZE):
            video.write(shot.image)
            bar.advance(task)
    return str(path)
