"""Going to a frame by its number: always the frame that reading from the start gives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.video.seek import Reel
from psiamfcpp.video.source import Source, open_source
from psiamfcpp.video.writer import VideoWriter

COUNT = 120


def shade(number: int) -> int:
    """Grey by which a frame is recognised, 2 levels from those beside it."""
    return 10 + 2 * (number % 110)


def shown(image: Any) -> float:
    return float(np.asarray(image).mean())


def all_of(source: Path) -> list[float]:
    with open_source(source) as video:
        return [shown(image) for image in video]


@pytest.fixture(params=["mp4", "mkv", "avi", "folder", "uneven"])
def source(request: Any, tmp_path: Path) -> Path:
    """A clip of grey frames, in several containers; ``uneven`` has time stamps of no steady rate."""
    frames = [np.full((64, 96, 3), shade(number), np.uint8) for number in range(COUNT)]
    if request.param == "folder":
        for number, frame in enumerate(frames):
            cv2.imwrite(str(tmp_path / f"{number}.png"), frame)
        return tmp_path
    if request.param == "uneven":
        return write_uneven(tmp_path / "uneven.mkv", frames)
    path = tmp_path / f"clip.{request.param}"
    with VideoWriter(path, 25, (96, 64)) as writer:
        for frame in frames:
            writer.write(frame)
    return path


def write_uneven(path: Path, frames: list[Any]) -> Path:
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"g": "40"})
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        at = 0
        for number, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts = at
            at += 1 if number % 7 else 4
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def test_any_order_of_frames_gives_what_reading_gives(source: Path) -> None:
    read = all_of(source)
    assert len(set(read)) > 100
    with open_source(source) as video:
        assert len(list(video)) == COUNT
        for number in (0, 119, 60, 61, 59, 20, 100, 3, 0, 118):
            video.seek(number)
            assert shown(next(video)) == read[number]
            if number + 1 < COUNT:
                assert shown(next(video)) == read[number + 1]


def test_frames_that_were_not_read_yet_are_counted(source: Path) -> None:
    read = all_of(source)
    with open_source(source) as video:
        for number in (77, 5):
            video.seek(number)
            assert shown(next(video)) == read[number]


def test_beyond_the_end_there_is_nothing(source: Path) -> None:
    with open_source(source) as video:
        video.seek(COUNT + 500)
        assert next(video, None) is None
        video.seek(1)
        assert shown(next(video)) == all_of(source)[1]


def test_jumps_that_land_elsewhere_are_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "clip.mp4"
    with VideoWriter(path, 25, (96, 64)) as writer:
        for number in range(COUNT):
            writer.write(np.full((64, 96, 3), shade(number), np.uint8))
    reel = Reel(path)
    while reel.read() is not None:
        pass

    class Astray:
        """A capture whose container seeks three frames too far."""

        def __init__(self, capture: Any):
            self._capture = capture

        def set(self, kind: int, value: float) -> bool:
            return bool(self._capture.set(kind, value + 3))

        def __getattr__(self, name: str) -> Any:
            return getattr(self._capture, name)

    reel.capture = Astray(reel.capture)  # type: ignore[assignment]
    reel.seek(70)
    assert shown(reel.read()) == all_of(path)[70]
    reel.close()


def test_what_is_live_has_no_frames_to_go_to() -> None:
    source = Source("camera 0", 30.0, None, True, iter(()), lambda: None)
    with pytest.raises(UserError, match="camera 0 is live"):
        source.seek(3)
