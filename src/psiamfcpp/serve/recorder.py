"""Video and boxes of what was followed, written by a thread of its own."""

from __future__ import annotations

import csv
import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from psiamfcpp.errors import UserError
from psiamfcpp.serve.follower import Follower, Shot
from psiamfcpp.video.drawing import draw_targets
from psiamfcpp.video.writer import VideoWriter

COLUMNS = ("seconds", "frame", "target", "x", "y", "w", "h", "score", "state")
# Frames that may wait for the encoder; more are left out of the video, and the ones before them shown for longer.
_WAITING = 4
# A gap in the stream becomes a still picture, but a night without one must not fill the disk.
_LONGEST_STILL_S = 10.0


class Recorder:
    """Writes ``FOLDER/DATE-TIME/video.mkv`` and ``boxes.csv``.

    The video runs at the source's rate whatever rate tracking reached: frames are repeated. Matroska, since what
    was written until the power fails can still be read.
    """

    def __init__(self, folder: Path, follower: Follower):
        """Check that the folder can be written to, creating it.

        Raises:
            UserError: it cannot.
        """
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
    def on(self) -> bool:
        """Whether it is recording."""
        thread = self._thread
        return thread is not None and thread.is_alive()

    def start(self) -> None:
        """Begin a recording; nothing happens while one runs."""
        with self._lock:
            if self.on:
                return
            self._shots = queue.Queue(_WAITING)
            self._thread = threading.Thread(target=self._run, args=(self._shots,), name="recorder")
            self._thread.start()
            if self._take not in self._follower.listeners:
                self._follower.listeners.append(self._take)

    def stop(self) -> None:
        """End the recording and finish its files; nothing happens where none runs."""
        with self._lock:
            if self._take in self._follower.listeners:
                self._follower.listeners.remove(self._take)
            if self._thread is not None:
                if self._thread.is_alive():
                    self._shots.put(None)
                self._thread.join()
                self._thread = None

    def _take(self) -> None:
        shot = self._follower.newest
        if shot is not None and shot.number != self._last and not self._shots.full():
            self._last = shot.number
            self._shots.put_nowait(shot)

    def _run(self, shots: queue.Queue[Shot | None]) -> None:
        try:
            folder = self._make_folder()
            self._follower.tell(f"recording to {folder}")
            _write(folder, self._follower.source_fps, shots.get)
            self._follower.tell(f"recorded {folder}")
        except (UserError, OSError) as error:
            self._follower.tell(f"recording ended: {error}")
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
            return folder
        raise UserError(f"recordings {self._folder} holds {name} already")


def _write(folder: Path, fps: float, get: Callable[[], Shot | None]) -> None:
    """Write shots until None comes."""
    shot = get()
    if shot is None:
        return
    height, width = shot.image.shape[:2]
    start, written = shot.read_at, 0
    with (
        (folder / "boxes.csv").open("w", newline="", encoding="utf-8") as file,
        VideoWriter(folder / "video.mkv", fps, (width, height)) as video,
    ):
        table = csv.writer(file)
        table.writerow(COLUMNS)
        while shot is not None:
            if shot.image.shape[:2] != (height, width):
                raise UserError(f"the stream changed its size from {width}x{height}: start a new recording")
            seconds = shot.read_at - start
            _write_rows(table, file, shot, seconds)
            picture = draw_targets(shot.image, shot.tracks)
            due = round(seconds * fps) + 1
            written = max(written, due - round(_LONGEST_STILL_S * fps))
            while written < due:
                video.write(picture)
                written += 1
            shot = get()


def _write_rows(table: Any, file: IO[str], shot: Shot, seconds: float) -> None:
    for number, track in shot.tracks.items():
        box = (f"{v:.2f}" for v in track.box)
        score = "" if track.score is None else f"{track.score:.3f}"
        table.writerow((f"{seconds:.3f}", shot.number, number, *box, score, track.state))
    # on disk with every frame, whatever ends the flight
    file.flush()
