"""Frames of a dataset, by reference: image files, and frames of video files."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.images import ImageReader, read_image
from psiamfcpp.video.capture import check_name, open_capture, sane_count

# JPEG at which another compression shows least: a frame is decoded in a third of the time that WebP takes.
_QUALITY = 95


class VideoFrame(NamedTuple):
    """One frame of a video file."""

    video: Path
    number: int
    """from 0"""


Frame = Path | VideoFrame
"""Where a frame is: an image file, or a place in a video file."""


def video_frames(video: Path) -> list[VideoFrame]:
    """References to every frame of a video file.

    Raises:
        UserError: the file is missing, or is no video that OpenCV can read.
    """
    with _opened(video) as capture:
        count = sane_count(capture) or 0
    # no frame takes less than a byte, so that a damaged header cannot promise more
    if not 0 < count <= video.stat().st_size:
        raise UserError(f"video {video} is damaged, its length of {count} frames cannot be true: fetch it again")
    return [VideoFrame(video, number) for number in range(count)]


def read_frame(frame: Frame, images: ImageReader | None = None) -> Image:
    """Return a frame as ``(height, width, 3)`` uint8, BGR.

    Frames of a video are cheap in order, since the decoder goes on from the last one; a frame before that begins anew.

    Args:
        frame: where it is.
        images: reader of the sequence, which gives images of more than 8 bits one range; by default each has its own.

    Raises:
        UserError: the file is missing or cannot be decoded, or the video ends before the frame.
    """
    return _DECODER.read(frame) if isinstance(frame, VideoFrame) else (images or ImageReader()).read(frame)


class FrameStore:
    """Frames for reading in any order: each video is decoded once, into image files of a folder.

    Several processes may share a folder. Without one, a temporary folder lasts as long as this object.
    """

    def __init__(self, folder: Path | None = None):
        self._temporary = folder is None
        self.folder = folder or Path(tempfile.mkdtemp(prefix="psiamfcpp-frames-"))
        if self._temporary:
            weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)

    def __reduce__(self) -> tuple[type[FrameStore], tuple[Path]]:
        # A loader process reads from the same folder, and does not remove it.
        return FrameStore, (self.folder,)

    def read(self, frame: Frame) -> Image:
        """A frame as ``(height, width, 3)`` uint8, BGR.

        Raises:
            UserError: it cannot be read or decoded, or the folder cannot be written.
        """
        if not isinstance(frame, VideoFrame):
            return read_image(frame)
        decoded = self._decoded(frame.video)
        path = decoded / f"{frame.number:06d}.jpg"
        if not path.exists():
            raise UserError(f"video {frame.video} ends before frame {frame.number}: fetch it again")
        return read_image(path)

    def _decoded(self, video: Path) -> Path:
        """The folder of a video's frames, decoded now if they are not there."""
        try:
            facts = video.stat()
        except OSError as error:
            raise UserError(f"video {video} cannot be read: {error}") from None
        # By time and size as well: a video fetched anew is another one.
        key = f"{video.resolve()}:{facts.st_size}:{facts.st_mtime_ns}"
        folder = self.folder / f"{video.stem}-{hashlib.sha256(key.encode()).hexdigest()[:12]}"
        if folder.is_dir():
            return folder
        part = folder.with_name(f"{folder.name}.{os.getpid()}.part")
        try:
            part.mkdir(parents=True, exist_ok=True)
            _decode(video, part)
            with contextlib.suppress(OSError):  # another process was first
                part.replace(folder)
        except OSError as error:
            raise UserError(f"frames cannot be stored in {self.folder} ({error}): make room, or name another") from None
        finally:
            shutil.rmtree(part, ignore_errors=True)
        return folder


def _decode(video: Path, folder: Path) -> None:
    with _opened(video) as capture:
        number = 0
        while True:
            there, image = capture.read()
            if not there:
                return
            _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            (folder / f"{number:06d}.jpg").write_bytes(data.tobytes())
            number += 1


class _Decoder:
    """The video read last, where it stands."""

    def __init__(self) -> None:
        self._video: Path | None = None
        self._capture: cv2.VideoCapture | None = None
        self._next = 0

    def read(self, frame: VideoFrame) -> Image:
        if self._capture is None or self._video != frame.video or frame.number < self._next:
            self._capture, self._video, self._next = _open(frame.video), frame.video, 0
        image = None
        while self._next <= frame.number:
            last = self._next == frame.number
            there = self._capture.grab()
            if there and last:
                there, image = self._capture.retrieve()
            if not there:
                self._capture = None
                raise UserError(f"video {frame.video} ends before frame {frame.number}: fetch it again")
            self._next += 1
        return np.asarray(image, dtype=np.uint8)


_DECODER = _Decoder()


def _open(video: Path) -> cv2.VideoCapture:
    check_name(str(video))
    if not video.is_file():
        raise UserError(f"video {video} does not exist, or is no file")
    # absolute, since FFmpeg takes what stands before a colon in a bare name for a protocol
    capture = open_capture(str(video.absolute()), None)
    if not capture.isOpened():
        raise UserError(f"video {video} cannot be read: replace or remove it")
    return capture


@contextlib.contextmanager
def _opened(video: Path) -> Iterator[cv2.VideoCapture]:
    capture = _open(video)
    try:
        yield capture
    finally:
        capture.release()
