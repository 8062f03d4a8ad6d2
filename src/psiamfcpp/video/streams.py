"""Videos that OpenCV would read wrongly, read by PyAV: those with several video streams, and those of 16-bit grey.

OpenCV reads the first stream, but a drone's MP4 may begin with a cover image, a thumbnail track or a small preview.
Where PyAV is installed, the stream with the most pixels is read. Of grey, OpenCV keeps the upper 8 bits, which is next
to nothing of a thermal camera's counts; PyAV gives all of them, to be stretched as those of images are.

Of other videos PyAV gives the same pixels as OpenCV in the same time (5.9 and 6.0 ms of processor per frame of H.264
at 1024x540). But it is not part of the core, so OpenCV reads them.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psiamfcpp.geometry import Image
from psiamfcpp.images import ImageReader

if TYPE_CHECKING:
    import av

# Enough to distinguish an image, or one frame per second, from a video.
_PACKETS = 500


@dataclass
class Stream:
    """A video stream that is read by PyAV."""

    fps: float | None
    count: int | None
    """frames that the container promises, if it does"""
    frames: Iterator[tuple[Image, float]]
    """frames ``(H, W, 3)`` uint8 BGR with their time stamps in seconds"""
    close: Callable[[], None]


def has_sound(source: str) -> bool:
    """Return whether a source is a file with a sound track; False where PyAV is not installed."""
    with contextlib.suppress(Exception):
        import av

        with Path(source).open("rb") as file, av.open(file, metadata_errors="ignore") as looked_at:
            return bool(looked_at.streams.audio)
    return False


def open_other_stream(path: Path) -> Stream | None:
    """Open the video stream that is meant, where OpenCV would read another, or lose most of it.

    Args:
        path: the file.

    Returns:
        The stream, or None where OpenCV reads what is meant, the file cannot be opened, or PyAV is not installed.
    """
    try:
        import av
    except ImportError:
        return None
    with contextlib.ExitStack() as stack:
        try:
            with av.open(str(path), metadata_errors="ignore") as looked_at:
                index = _meant(looked_at)
                deep = _is_deep(looked_at.streams.video[index]) if looked_at.streams.video else False
            if not index and not deep:
                return None
            # anew, since a file that is cut off has no index to go back by
            container = stack.enter_context(av.open(str(path), metadata_errors="ignore"))
        except (av.FFmpegError, ValueError):
            return None
        stream = container.streams.video[index]
        stream.thread_type = "AUTO"
        rate = float(stream.average_rate) if stream.average_rate else None
        length_s = container.duration / av.time_base if container.duration else None
        return Stream(rate, _count(stream, rate, length_s), _frames(av, container, stream, deep), stack.pop_all().close)


def is_whole(path: Path, read: int, promised_s: float) -> bool:
    """Whether a file reaches its end, though fewer frames were read than its length would hold.

    A container's length is that of its longest stream: where the sound goes on after the last image, frames seem to
    be missing.

    Args:
        path: the file.
        read: frames that were read.
        promised_s: length that the container promises, seconds.

    Returns:
        False also where PyAV is not installed, and nothing is known.
    """
    try:
        import av
    except ImportError:
        return False
    last_s, packets = 0.0, Counter[int]()
    try:
        with av.open(str(path), metadata_errors="ignore") as container:
            for packet in container.demux():
                if packet.pts is not None and packet.size:
                    packets[packet.stream.index] += 1
                    last_s = max(last_s, float((packet.pts + (packet.duration or 0)) * packet.time_base))
            most = max((packets[stream.index] for stream in container.streams.video), default=0)
    except (av.FFmpegError, ValueError):
        return False
    return promised_s - last_s <= max(0.5, 0.01 * promised_s) and most - read <= max(2.0, 0.01 * most)


def _meant(container: av.container.InputContainer) -> int:
    """Which of the video streams has the most pixels in what comes first; a cover image has next to none."""
    streams = container.streams.video
    if len(streams) < 2:
        return 0
    packets: Counter[int] = Counter()
    for number, packet in enumerate(container.demux(streams)):
        packets[packet.stream.index] += bool(packet.size)
        if number >= _PACKETS:
            break
    pixels = [
        packets[stream.index] * stream.width * stream.height if stream.codec_context is not None else 0
        for stream in streams
    ]
    return pixels.index(max(pixels))


def _count(stream: Any, rate: float | None, length_s: float | None) -> int | None:
    if stream.frames:
        return int(stream.frames)
    if stream.duration:
        length_s = float(stream.duration * stream.time_base)
    return round(length_s * rate) if length_s and rate else None


def _is_deep(stream: Any) -> bool:
    """Whether a stream is grey with more than 8 bits."""
    # a stream of an unknown codec has none
    form = getattr(stream, "format", None)
    return form is not None and len(form.components) == 1 and form.components[0].bits > 8


def _frames(av: Any, container: Any, stream: Any, deep: bool) -> Iterator[tuple[Image, float]]:
    reader = ImageReader()
    try:
        for packet in container.demux(stream):
            try:
                found = packet.decode()
            except av.FFmpegError:
                continue  # a damaged packet; the next may be whole
            for frame in found:
                if deep:
                    image = reader.stretched(np.repeat(frame.to_ndarray(format="gray16le")[..., None], 3, axis=2))
                else:
                    image = frame.to_ndarray(format="bgr24")
                # the display matrix says how far to turn it, counter-clockwise, as OpenCV does by itself
                turned = np.rot90(image, round(getattr(frame, "rotation", 0) / 90))
                yield np.ascontiguousarray(turned), float(frame.time or 0.0)
    except av.FFmpegError:
        return
