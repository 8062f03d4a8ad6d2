"""Videos and boxes on their way to disk: what was written stays valid, however the writing ends."""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import math
import os
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image

if TYPE_CHECKING:
    from av import VideoFrame


SUFFIXES = (".mp4", ".mov", ".mkv", ".avi")
BEARS_CUTS = ".mkv"
"""the format that players open although its end is missing"""
_CLUSTER_MS = 100
_PROBE = 2**16
_DISK = "check that the disk has room"


class VideoWriter:
    """A video that takes its final name only once it is whole.

    Whatever ends the ``with`` block, Ctrl-C or an error, the frames written so far become a valid video.
    Where no frame was written, nothing is left. Where the disk is full, a Matroska file (``.mkv``) keeps what was
    written before, since players open it although it is cut; of the other formats nothing is left.
    H.264 where PyAV is installed, else MPEG-4. With PyAV, a Matroska file is on disk but for its last 0.1 s while it
    is written, in ``.NAME.PID.part.mkv``: it survives the end of the process, whatever that is.
    """

    def __init__(self, path: str | Path, fps: float, size: tuple[int, int]) -> None:
        """Check that the video can be written.

        Args:
            path: the file; ``.mp4``, ``.mov``, ``.mkv`` or ``.avi``. An older one is replaced at the end.
            fps: frames a second.
            size: ``(width, height)`` in pixels; an odd side gains one pixel in the video.

        Raises:
            UserError: unknown suffix, a folder that is missing or must not be written to, no rate or no size.
        """
        self._path, self._size = Path(path), size
        if self._path.suffix.lower() not in SUFFIXES:
            raise UserError(f"video {path} has an unknown format: end its name in {', '.join(SUFFIXES)}")
        try:
            str(path).encode("utf-8")
            if self._path.is_dir():
                raise UserError(f"video {path} cannot be written: a folder has that name")
            special = self._path.exists() and not self._path.is_file()
        except (UnicodeEncodeError, OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or "rename it, so that its name is UTF-8"
            raise UserError(f"video {path} cannot be written: {reason}") from None
        if special:
            raise UserError(f"video {path} cannot be written: it is a pipe or a device")
        if not (math.isfinite(fps) and fps > 0) or min(size) < 1:
            raise UserError(f"video {path} cannot have {fps:g} fps at {size[0]}x{size[1]}: give more than 0")
        self._part = self._path.with_name(f".{self._path.stem}.{os.getpid()}.part{self._path.suffix}")
        try:
            self._part.open("wb").close()
        except OSError as error:
            raise UserError(f"video {path} cannot be written: {error.strerror or error}") from None
        self._count = 0
        self._open = True
        width, height = size[0] + size[0] % 2, size[1] + size[1] % 2
        try:
            self._encoder = _encoder(self._part, fps, (width, height))
        except OSError as error:
            self._part.unlink(missing_ok=True)
            raise UserError(f"video {path} cannot be written: {error.strerror or error}") from None
        except BaseException:
            self._part.unlink(missing_ok=True)
            raise

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, frame: Image) -> None:
        """Append a frame ``(H, W, 3)`` uint8 BGR.

        Raises:
            UserError: a frame of another size than the video, or a disk that is full, which ends the video.
        """
        height, width = frame.shape[:2]
        if (width, height) != self._size:
            raise UserError(
                f"frame of {width}x{height} does not fit video {self._path}: "
                f"keep all frames {self._size[0]}x{self._size[1]}"
            )
        if width % 2 or height % 2:
            frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        try:
            self._encoder.write(np.ascontiguousarray(frame))
        except OSError as error:
            raise self._failed(error) from None
        self._count += 1

    def hold(self, frames: int) -> None:
        """Repeat the frame that was written last for a number of frames.

        With PyAV this costs nothing: the next frame is stamped later.

        Raises:
            UserError: the disk is full, which ends the video.
        """
        try:
            self._encoder.hold(frames)
        except OSError as error:
            raise self._failed(error) from None

    def close(self) -> None:
        """Finish the video and give it its name; may be called twice.

        Raises:
            UserError: the disk is full.
        """
        if not self._open:
            return
        self._open = False
        try:
            self._encoder.finish()
            if self._count:
                self._part.replace(self._path)
        except OSError as error:
            if self._count:
                raise self._failure(error) from None
        finally:
            # interrupted for a second time, or nothing was written
            self._keep_what_plays()

    def _failed(self, error: OSError) -> UserError:
        """End the video that a write could not go on with."""
        self._open = False
        with contextlib.suppress(OSError):
            self._encoder.finish()
        return self._failure(error)

    def _failure(self, error: OSError) -> UserError:
        kept = self._keep_what_plays()
        found = f"; what was written until then is in {kept}" if kept else ""
        return UserError(f"video {self._path} cannot be written: {error.strerror or error}; {_DISK}{found}")

    def _keep_what_plays(self) -> Path | None:
        """Name what an unfinished video left, where players open it and nothing is overwritten; remove it elsewhere."""
        kept = None
        if self._count and self._path.suffix.lower() == BEARS_CUTS and self._part.exists():
            path = self._path if not self._path.exists() else self._path.with_stem(f"{self._path.stem}.cut")
            with contextlib.suppress(OSError):
                kept = self._part.replace(path)
        self._part.unlink(missing_ok=True)
        return kept


class LineWriter:
    """A text file that is on disk line by line, and never holds a part of what was written at once."""

    def __init__(self, path: str | Path, name: str) -> None:
        """Start the file anew.

        Args:
            path: the file.
            name: what messages call it.

        Raises:
            UserError: it cannot be created.
        """
        self._path, self._name, self._size = Path(path), name, 0
        try:
            # unbuffered: only then is a line that did not fit known, and taken back, at once
            self._file = self._path.open("wb", buffering=0)
        except OSError as error:
            raise UserError(f"{name} {path} cannot be written: {error.strerror or error}") from None

    def __enter__(self) -> LineWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, *lines: str) -> None:
        """Append lines, all or none of them.

        Raises:
            UserError: the disk is full; the lines before stay.
        """
        data = "".join(f"{line}\n" for line in lines).encode()
        try:
            written = self._file.write(data)
            reason = "" if written == len(data) else "the line did not fit"
        except OSError as error:
            reason = error.strerror or str(error)
        if reason:
            with contextlib.suppress(OSError):
                self._file.truncate(self._size)
            raise UserError(f"{self._name} {self._path} cannot be written: {reason}; {_DISK}")
        self._size += len(data)

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()


class _H264:
    """H.264 by PyAV; raises OSError where the disk fails."""

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        import av

        self._av = av
        rate = Fraction(fps).limit_denominator(1001)
        # a tracker shares the processor: the slower presets would take more of it than the tracker does
        options = {"crf": "23", "preset": "veryfast"}
        on_disk: dict[str, str] = {}
        if path.suffix.lower() == BEARS_CUTS:
            # What the encoder, the cluster and the buffer hold is lost with the process: by default 14 s and more.
            options["tune"] = "zerolatency"
            on_disk = {"cluster_time_limit": str(_CLUSTER_MS), "flush_packets": "1"}
        try:
            self._container = av.open(str(path), "w", options=on_disk)
        except av.FFmpegError as error:
            raise OSError(error.errno, error.strerror) from None
        self._stream = self._container.add_stream("libx264", rate=rate, options=options)
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        self._time_base, self._count = 1 / rate, 0

    def write(self, frame: Image) -> None:
        image = self._av.VideoFrame.from_ndarray(frame, format="bgr24")
        image.pts, image.time_base = self._count, self._time_base
        self._count += 1
        self._mux(image)

    def hold(self, frames: int) -> None:
        self._count += frames

    def finish(self) -> None:
        try:
            if self._count:
                self._mux(None)
        finally:
            try:
                self._container.close()
            except self._av.FFmpegError as error:
                raise OSError(error.errno, error.strerror) from None

    def _mux(self, image: VideoFrame | None) -> None:
        try:
            self._container.mux(self._stream.encode(image))
        except self._av.FFmpegError as error:
            raise OSError(error.errno, error.strerror) from None


class _Mpeg4:
    """MPEG-4 by OpenCV; raises OSError where the disk fails."""

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        self._path = path
        self._writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
        if not self._writer.isOpened():
            raise UserError(f"video {path} cannot be encoded by this OpenCV: install PyAV (pip install av)")

    def write(self, frame: Image) -> None:
        self._writer.write(frame)
        self._last = frame

    def hold(self, frames: int) -> None:
        for _ in range(frames):
            self._writer.write(self._last)

    def finish(self) -> None:
        self._writer.release()
        # OpenCV says nothing of a write that failed: but where one did, more would not fit either
        with self._path.open("ab", buffering=0) as file:
            size = file.tell()
            fits = file.write(bytes(_PROBE)) == _PROBE
            file.truncate(size)
        if not fits:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def writes_h264() -> bool:
    """Return whether videos are written as H.264, which browsers play; as MPEG-4 they are played by few."""
    return importlib.util.find_spec("av") is not None


def _encoder(path: Path, fps: float, size: tuple[int, int]) -> _H264 | _Mpeg4:
    return _H264(path, fps, size) if writes_h264() else _Mpeg4(path, fps, size)
