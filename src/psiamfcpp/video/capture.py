"""OpenCV's capture, opened without chatter and without hanging, and what its numbers are worth."""

from __future__ import annotations

import contextlib
import math
import os
import threading
from collections.abc import Iterator

import cv2

from psiamfcpp.errors import UserError
from psiamfcpp.images import quiet_opencv

FALLBACK_FPS = 30.0
SESSION_SUFFIX = ".sdp"
"""of a file that describes an RTP session"""

# OpenCV reads this variable whenever it opens something.
_OPTIONS, _SESSION_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist;file,rtp,udp"
_session_lock = threading.Lock()

# OpenCV takes this number of packets in a row without a frame for the end of the file: by default 4,096 of sound or
# telemetry between two images, and 64 damaged ones. -8 is the level "quiet" of FFmpeg.
_SETTINGS = {
    "OPENCV_FFMPEG_LOGLEVEL": "-8",
    "OPENCV_FFMPEG_READ_ATTEMPTS": str(2**31 - 1),
    "OPENCV_FFMPEG_DECODE_ATTEMPTS": str(2**31 - 1),
}


def check_name(text: str) -> None:
    """Refuse what cannot be a name here, and what OpenCV and FFmpeg would crash on.

    Raises:
        UserError: the name is empty, holds a zero byte or is not UTF-8.
    """
    try:
        bad = "\0" in text or not text.encode("utf-8")
    except UnicodeEncodeError:
        bad = True
    if bad:
        raise UserError(f"{text!r} cannot be read: rename it, so that its name is UTF-8 and not empty")


def open_capture(target: int | str, timeout_s: float | None) -> cv2.VideoCapture:
    """Return a capture of a camera, file, address or pipeline; whether it could be opened is for the caller to ask.

    Args:
        target: camera number, path, address, description of a session (.sdp), or GStreamer pipeline.
        timeout_s: for an address or a session: how many seconds opening it, and waiting for a frame, may take.
    """
    # read once, when FFmpeg is first used
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    quiet_opencv()
    if isinstance(target, int):
        return cv2.VideoCapture(target)
    if is_pipeline(target):
        return cv2.VideoCapture(target, cv2.CAP_GSTREAMER)
    if timeout_s is None:
        return cv2.VideoCapture(target)
    limit = max(1, int(timeout_s * 1000))
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit]
    # other backends refuse these limits, and would hang without them
    with _protocols_of(target):
        return cv2.VideoCapture(target, cv2.CAP_FFMPEG, limits)


def is_pipeline(target: str) -> bool:
    """Return whether a source is a GStreamer pipeline: elements with exclamation marks between them."""
    return " ! " in target


def has_gstreamer() -> bool:
    """Return whether this OpenCV was built with GStreamer; the wheels of PyPI are not."""
    return bool(cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER))


@contextlib.contextmanager
def _protocols_of(target: str) -> Iterator[None]:
    """Let FFmpeg open the ports that a session description names: by default a file may name files only."""
    if not target.lower().endswith(SESSION_SUFFIX):
        yield
        return
    with _session_lock:
        before = os.environ.get(_OPTIONS)
        os.environ[_OPTIONS] = _SESSION_OPTIONS
        try:
            yield
        finally:
            if before is None:
                del os.environ[_OPTIONS]
            else:
                os.environ[_OPTIONS] = before


def sane_fps(capture: cv2.VideoCapture) -> float | None:
    """Frames a second, or None where the container says nothing that a video could have."""
    fps = capture.get(cv2.CAP_PROP_FPS)
    return fps if 0.1 <= fps <= 1000 else None


def sane_count(capture: cv2.VideoCapture) -> int | None:
    """How many frames the container promises, or None where it does not."""
    count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    return int(count) if 1 <= count < 2**31 else None


def ended_early(read: int, position_s: float, count: int | None, fps: float | None) -> bool:
    """Whether a decoder stopped well before the end that its container promised.

    The count is often an estimate, duration times frame rate, far off where the rate varies: so the time
    stamp of the last frame may stand in for it.

    Args:
        read: frames that were read.
        position_s: time stamp of the last of them, in seconds.
        count: frames that were promised, if any were.
        fps: frames a second, if known.
    """
    if count is None:
        return False
    reached = max(read, math.floor(position_s * (fps or 0)) + 1)
    return count - reached > max(2.0, 0.01 * count)
