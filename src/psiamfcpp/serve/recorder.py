"""Video and boxes of what was followed, written by a thread of its own."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
import time
from pathlib import Path

from psiamfcpp.errors import UserError
from psiamfcpp.serve.follower import BusyError, Follower, Shot
from psiamfcpp.video.boxes import COLUMNS, csv_row
from psiamfcpp.video.drawing import draw_targets
from psiamfcpp.video.writer import LineWriter, VideoWriter

# Frames that may wait for the encoder; more are left out of the video, and the ones before them shown for longer.
_WAITING = 2
# A gap in the stream becomes a still image, but a night without one must not fill the disk.
_LONGEST_STILL_S = 10.0
# What the system holds back is lost when the power fails: by default up to half a minute of it.
_SYNC_S = 1.0


class Recorder:
    """Writes ``FOLDER/DATE-TIME/video.mkv`` and ``boxes.csv``.

    The video runs at the source's rate whatever rate tracking reached: frames are repeated, or shown for longer. It
    is Matroska, since what was written until the process is killed, the power fails or the disk is full can still be
    read.
    """

    def __init__(self, folder: Path, follower: Follower):
        """Check that the folder can be written to, creating it.

        Raises:
            UserError: it cannot, or PyAV is missing.
        """
        try:
            import av  # noqa: F401 - without it a video is on disk minutes late
        except ImportError:
            raise UserError("recording needs PyAV: pip install 'psiamfcpp[serve]'") from None
        self._folder, self._follower = folder, follower
        try:
            folder.mkdir(parents=True, exist_ok=True)
            probe = folder / ".writable"
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise UserError(f"recordings {folder} cannot be written: {error.strerror or error}") from None
        self._lock = threading.Lock()
        self._shots: queue.Queue[Shot | None] = queue.Queue(_WAITING)
        self._thread: threading.Thread | None = None
        self._last = 0

    @property
    def folder(self) -> Path:
        """Where recordings are written to, a folder each."""
        return self._folder

    @property
    def on(self) -> bool:
        """Whether it is recording."""
        thread = self._thread
        return thread is not None and thread.is_alive()

    def start(self) -> None:
        """Begin a recording, whose files are there when this returns; nothing happens while one runs.

        Raises:
            BusyError: no frame has come yet.
            UserError: the files cannot be created.
        """
        with self._lock:
            if self.on:
                return
            shot = self._follower.newest
            if shot is None:
                raise BusyError("no frame has come yet: try again")
            recording = _Recording(self._make_folder(), self._follower.source_fps, shot)
            self._shots = queue.Queue(_WAITING)
            self._shots.put(shot)
            self._last = shot.number
            self._thread = threading.Thread(target=self._run, args=(recording, self._shots), name="recorder")
            self._thread.start()
            if self._take not in self._follower.listeners:
                self._follower.listeners.append(self._take)

    def stop(self) -> None:
        """End the recording and finish its files; nothing happens where none runs."""
        with self._lock:
            if self._take in self._follower.listeners:
                self._follower.listeners.remove(self._take)
            if self._thread is not None:
                while self._thread.is_alive():
                    # again and again: a thread that ends by itself makes no room any more
                    with contextlib.suppress(queue.Full):
                        self._shots.put(None, timeout=0.1)
                        break
                self._thread.join()
                self._thread = None

    def _take(self) -> None:
        shot = self._follower.newest
        # called in any thread that reports something, so that what has room now may have none in a moment
        with contextlib.suppress(queue.Full):
            if shot is not None and shot.number != self._last:
                self._shots.put_nowait(shot)
                self._last = shot.number

    def _run(self, recording: _Recording, shots: queue.Queue[Shot | None]) -> None:
        shot: Shot | None = None
        try:
            while True:
                self._follower.tell(f"recording to {recording.folder.name}")
                with recording:
                    shot = _fill(recording, shots, shot)
                self._follower.tell(f"recorded {recording.folder.name}")
                if shot is None:
                    return
                # a camera that comes back in another mode is recorded on
                height, width = shot.image.shape[:2]
                self._follower.tell(f"the stream changed its size to {width}x{height}")
                recording = _Recording(self._make_folder(), self._follower.source_fps, shot)
        except Exception as error:  # whatever it is, the operator must know that nothing is recorded any more
            self._follower.tell(f"recording ended: {' '.join(str(error).split()) or type(error).__name__}")
        finally:
            # so that a last `put` finds room
            while not shots.empty():
                shots.get_nowait()

    def _make_folder(self) -> Path:
        name = time.strftime("%Y%m%d-%H%M%S")
        for suffix in ("", *(f"-{n}" for n in range(2, 100))):
            folder = self._folder / f"{name}{suffix}"
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            except OSError as error:
                raise UserError(f"recordings {self._folder} cannot be written: {error.strerror or error}") from None
            return folder
        raise UserError(f"recordings {self._folder} holds {name} already")


def _fill(recording: _Recording, shots: queue.Queue[Shot | None], first: Shot | None) -> Shot | None:
    """Record until the end, or until a shot of another size comes, which is returned."""
    shot = first or shots.get()
    while shot is not None and recording.fits(shot):
        recording.write(shot, behind=not shots.empty())
        shot = shots.get()
    return shot


class _Recording:
    """The files of one recording, from its first frame until its ``with`` block ends."""

    def __init__(self, folder: Path, fps: float, first: Shot):
        self.folder, self._fps = folder, fps
        height, width = first.image.shape[:2]
        self._size = (width, height)
        self._start, self._written = first.read_at, 0
        self._done = threading.Event()
        self._syncer = threading.Thread(target=self._sync, name="recorder sync", daemon=True)
        with contextlib.ExitStack() as stack:
            stack.callback(self._remove_empty)
            self._table = stack.enter_context(LineWriter(folder / "boxes.csv", "boxes"))
            self._video = stack.enter_context(VideoWriter(folder / "video.mkv", fps, self._size))
            self._table.write(",".join(COLUMNS))
            self._stack = stack.pop_all()

    def __enter__(self) -> _Recording:
        self._syncer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._syncer.join()
        self._stack.close()

    def fits(self, shot: Shot) -> bool:
        """Whether a frame has the size of this video."""
        height, width = shot.image.shape[:2]
        return (width, height) == self._size

    def write(self, shot: Shot, behind: bool) -> None:
        """Append a frame and its targets.

        Args:
            shot: the frame.
            behind: others wait, so none is repeated: the one before is only shown for longer. Else a processor
                that encodes fewer frames than the source has would fall behind more and more.

        Raises:
            UserError: the disk is full, or the frame has another size than the first.
        """
        seconds = max(0.0, shot.read_at - self._start)
        self._table.write(*(csv_row(seconds, shot.number, *target) for target in shot.tracks.items()))
        image = draw_targets(shot.image, shot.tracks)
        due = round(seconds * self._fps) + 1
        self._written = max(self._written, due - round(_LONGEST_STILL_S * self._fps))
        if behind and self._written and due > self._written + 1:
            self._video.hold(due - self._written - 1)
            self._written = due - 1
        while self._written < due:
            self._video.write(image)
            self._written += 1

    def _remove_empty(self) -> None:
        """Remove the folder if nothing was recorded."""
        with contextlib.suppress(OSError):
            if not self._written:
                (self.folder / "boxes.csv").unlink(missing_ok=True)
                self.folder.rmdir()

    def _sync(self) -> None:
        """Have the system write what it holds, in a thread of its own, for some cards take their time."""
        while not self._done.wait(_SYNC_S):
            with contextlib.suppress(OSError):  # the recording itself will say so
                for path in self.folder.iterdir():
                    file = os.open(path, os.O_RDONLY)
                    try:
                        os.fsync(file)
                    finally:
                        os.close(file)
