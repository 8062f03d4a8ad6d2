"""Where frames come from: a video, a camera, a network stream, a folder of images or a glob of them."""

from __future__ import annotations

import glob
import importlib.util
import itertools
import re
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.images import IMAGE_SUFFIXES, ImageReader, image_files
from psiamfcpp.video.capture import (
    FALLBACK_FPS,
    SESSION_SUFFIX,
    check_name,
    ended_early,
    has_gstreamer,
    is_pipeline,
    sane_count,
    sane_fps,
)
from psiamfcpp.video.live import LiveReader
from psiamfcpp.video.seek import Reel
from psiamfcpp.video.streams import Stream, is_whole, open_other_stream

_CAMERA_DIGITS = 4
_URL_SCHEMES = tuple(
    f"{scheme}://" for scheme in ("rtsp", "rtsps", "http", "https", "udp", "srt", "rtmp", "rtmps", "tcp")
)
_KINDS = "a video, a camera number, an address (rtsp://, udp://, http://), a folder of images or a glob of them"


@dataclass
class Source:
    """Frames one after the other, ``(H, W, 3)`` uint8 BGR; also a context manager that closes itself."""

    name: str
    """what the user gave, without the password that an address may hold"""
    fps: float
    frame_count: int | None
    """frames that the container or the folder promises; None where that is unknown, and always when live"""
    live: bool
    """frames come as they happen: those that were not asked for in time are skipped"""
    _frames: Iterator[Image]
    _close: Callable[[], None]
    _from: Callable[[int], Iterator[Image]] | None = None
    """the frames from a number on"""

    def __iter__(self) -> Iterator[Image]:
        return self

    def __next__(self) -> Image:
        return next(self._frames)

    def __enter__(self) -> Source:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def seek(self, number: int) -> None:
        """Go to a frame of a file or folder, so that it is read next; beyond the last one, to the end.

        Args:
            number: of the frame, from 0, as reading from the first frame counts it.

        Raises:
            UserError: the source is live.
        """
        if self._from is None:
            raise UserError(f"{self.name} is live: there is nothing but its newest frame")
        self._frames = self._from(number)

    def close(self) -> None:
        """Release the file or device, and end a live source's reader thread; may be called twice."""
        self._close()
        self._frames = iter(())


def open_source(
    source: str | int | Path,
    *,
    fps: float | None = None,
    on_event: Callable[[str], None] | None = None,
    reconnect_s: float = 15.0,
    timeout_s: float = 5.0,
) -> Source:
    """Open whatever ``source`` names.

    Files and folders are read frame by frame. Cameras and addresses are live: only the newest frame is kept,
    and when they fall silent they are opened again and again, with growing pauses.

    Args:
        source: a video or image file, a camera number (``0`` or ``"0"``), an address (rtsp, http, udp, srt, rtmp or
            tcp, as far as the installed OpenCV takes it), a session description (``.sdp``), a GStreamer pipeline
            (``"... ! appsink"``), a folder of images, or a glob of images (``"frames/*.jpg"``).
        fps: frames a second, instead of what the container says (or of 30 where it says nothing sane).
        on_event: receives one line when a live source breaks off and when it is back; called while the next
            frame is asked for, in the thread that asks.
        reconnect_s: how many seconds a live source may stay silent before it is given up; `math.inf` for never.
        timeout_s: how many seconds opening an address, or waiting for its next frame, may take.

    Returns:
        The source. Iterating ends with a `UserError` after the frames that could be read where a video is cut
        off, a live source does not come back, or an image is unreadable or of another size than the first.

    Raises:
        UserError: it does not exist, or holds no frame that can be read.
    """
    text = str(source)
    if isinstance(source, int) or (isinstance(source, str) and source.isdecimal()):
        if len(text) > _CAMERA_DIGITS or int(text) < 0:
            raise UserError(f"camera {text[:40]} cannot be opened: give a number from 0 to {10**_CAMERA_DIGITS - 1}")
        return _live(int(text), f"camera {text}", fps, on_event, reconnect_s, timeout_s)
    check_name(text)
    if is_pipeline(text):
        if not has_gstreamer():
            raise UserError("this OpenCV has no GStreamer, so it runs no pipeline: install one that was built with it")
        return _live(text, "pipeline", fps, on_event, reconnect_s, timeout_s)
    if text.lower().startswith(_URL_SCHEMES):
        return _live(text, f"stream {_without_password(text)}", fps, on_event, reconnect_s, timeout_s)
    try:
        path = Path(text).expanduser()
        kind = path.stat().st_mode if path.exists() else 0
        inside = list(path.iterdir()) if stat.S_ISDIR(kind) else []
    except (OSError, RuntimeError) as error:  # RuntimeError: the home of a user that is not there
        raise UserError(f"{text} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if stat.S_ISDIR(kind):
        return _images(image_files(inside), text, f"folder {text} holds no image", fps)
    if kind and not stat.S_ISREG(kind):
        raise UserError(f"{text} is a pipe or a device: give {_KINDS}")
    if kind:
        if path.suffix.lower() in IMAGE_SUFFIXES:
            return _images([path], text, "", fps)
        if path.suffix.lower() == SESSION_SUFFIX:
            return _live(str(path.absolute()), f"session {text}", fps, on_event, reconnect_s, timeout_s)
        return _video(path, text, fps)
    if glob.has_magic(text):
        found = (Path(p) for p in glob.glob(str(path), recursive=True))  # noqa: PTH207 - the pattern may be absolute
        return _images(image_files(found), text, f"{text} matches no image", fps)
    raise UserError(f"{text} does not exist: give {_KINDS}")


def _live(
    target: int | str,
    name: str,
    fps: float | None,
    on_event: Callable[[str], None] | None,
    reconnect_s: float,
    timeout_s: float,
) -> Source:
    reader = LiveReader(target, name, on_event, reconnect_s, timeout_s)
    return Source(name, fps or reader.fps, None, True, reader.frames(), reader.close)


def _video(path: Path, name: str, fps: float | None) -> Source:
    other = open_other_stream(path)
    if other is not None:
        reopened = _Other(other, path, name)
        if (shown := next(reopened.frames, None)) is not None:
            played = fps or reopened.stream.fps or FALLBACK_FPS
            read = itertools.chain([shown], reopened.frames)
            return Source(name, played, reopened.stream.count, False, read, reopened.close, reopened.seek)
        reopened.close()
    reel = Reel(path)
    first = reel.read()
    # FFmpeg takes plain text for "ansi" video
    if first is None or int(reel.capture.get(cv2.CAP_PROP_FOURCC)) == cv2.VideoWriter.fourcc(*"ansi"):
        empty = reel.capture.isOpened() and first is None
        reel.close()
        if empty:
            raise UserError(f"video {name} holds no frame that can be read: record or copy it again")
        raise UserError(f"{name} is not a video that can be read (or is cut off): give {_KINDS}")
    count, rate = sane_count(reel.capture), sane_fps(reel.capture)

    def start_from(number: int) -> Iterator[Image]:
        reel.seek(number)
        return _video_frames(reel, None, path, name, count, rate)

    frames = _video_frames(reel, first, path, name, count, rate)
    return Source(name, fps or rate or FALLBACK_FPS, count, False, frames, reel.close, start_from)


class _Other:
    """A stream that PyAV reads; to go back it is read anew."""

    def __init__(self, stream: Stream, path: Path, name: str):
        self._path, self._name, self.stream = path, name, stream
        self.frames = _other_frames(stream, path, name)

    def seek(self, number: int) -> Iterator[Image]:
        self.close()
        stream = open_other_stream(self._path)
        if stream is None:
            raise UserError(f"video {self._name} cannot be read any more: it was changed or removed")
        self.stream, self.frames = stream, _other_frames(stream, self._path, self._name)
        return itertools.islice(self.frames, number, None)

    def close(self) -> None:
        self.stream.close()


def _other_frames(stream: Stream, path: Path, name: str) -> Iterator[Image]:
    read, position_s = 0, 0.0
    for image, stamp_s in stream.frames:
        read, position_s = read + 1, stamp_s
        yield image
    _check_end(path, name, read, position_s, stream.count, stream.fps)


def _video_frames(
    reel: Reel, first: Image | None, path: Path, name: str, count: int | None, rate: float | None
) -> Iterator[Image]:
    if first is not None:
        yield first
    position_s = 0.0
    while (frame := reel.read()) is not None:
        position_s = reel.position_s
        yield frame
    alone = first is not None and reel.next == 1 and path.stat().st_size > _largest_as_image(first)
    if alone and importlib.util.find_spec("av") is None:
        fix = "pip install 'psiamfcpp[video]' reads the rest"
        raise UserError(f"video {name} holds more than the one image that can be read: {fix}")
    _check_end(path, name, reel.next, position_s, count, rate)


def _largest_as_image(frame: Image) -> int:
    """Bytes of a file that holds nothing but this frame, generously."""
    return 4096 + 2 * len(cv2.imencode(".jpg", frame)[1])


def _check_end(path: Path, name: str, read: int, position_s: float, count: int | None, rate: float | None) -> None:
    if not ended_early(read, position_s, count, rate):
        return
    if count and rate and is_whole(path, read, count / rate):
        return
    raise UserError(f"video {name} is cut off: {read} of {count} frames could be read; copy it again")


def _images(paths: list[Path], name: str, none: str, fps: float | None) -> Source:
    if not paths:
        raise UserError(f"{none}: {', '.join(sorted(IMAGE_SUFFIXES))} are read")
    return Source(
        name,
        fps or FALLBACK_FPS,
        len(paths),
        False,
        _image_frames(paths),
        lambda: None,
        lambda number: _image_frames(paths[number:]),
    )


def _image_frames(paths: list[Path]) -> Iterator[Image]:
    size: tuple[int, int] | None = None
    reader = ImageReader()
    for path in paths:
        frame = reader.read(path)
        height, width = frame.shape[:2]
        if size is None:
            size = (width, height)
        if (width, height) != size:
            raise UserError(
                f"image {path} is {width}x{height}, those before it {size[0]}x{size[1]}: make them one size"
            )
        yield frame


def _without_password(url: str) -> str:
    return re.sub(r"(?<=://)([^/@]*?):[^/]*@", r"\1:***@", url)
