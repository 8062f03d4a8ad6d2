"""Writers: whatever ends the writing, what is on disk is valid."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.video.source import Image, open_source
from psiamfcpp.video.writer import VideoWriter


@pytest.fixture(params=["h264", "mpeg4"])
def codec(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "h264":
        pytest.importorskip("av")
    else:
        # as where it is not installed: neither found nor imported
        monkeypatch.setitem(sys.modules, "av", None)
    return str(request.param)


@pytest.fixture
def refused_on(disk_of: Callable[[int], AbstractContextManager[None]]) -> Callable[[int, Path, str], None]:
    """Writes 80 frames of noise to a disk of some bytes, which the writer is to complain of."""

    def write(size: int, path: Path, complaint: str) -> None:
        frames = noise(80, 320, 240)
        with (
            disk_of(size),
            pytest.raises(UserError, match=f"{path} cannot be written{complaint}"),
            VideoWriter(path, 25, (320, 240)) as writer,
        ):
            for frame in frames:
                writer.write(frame)

    return write


def noise(count: int, width: int = 64, height: int = 48) -> list[Image]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 255, (height, width, 3), dtype=np.uint8) for _ in range(count)]


def read(path: Path) -> list[Image]:
    with open_source(path) as source:
        return list(source)


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv", ".avi", ".MP4"])
@pytest.mark.parametrize("size", [(64, 48), (65, 47)])
def test_a_video_reads_back(tmp_path: Path, codec: str, suffix: str, size: tuple[int, int]) -> None:
    path, (width, height) = tmp_path / f"a{suffix}", size
    with VideoWriter(path, 25, size) as writer:
        for i in range(12):
            frame = np.full((height, width, 3), (20 * i, 100, 200), np.uint8)
            writer.write(frame)
    frames = read(path)
    assert len(frames) == 12
    assert frames[0].shape == (height + height % 2, width + width % 2, 3)
    assert np.allclose([f[:, :, 0].mean() for f in frames], np.arange(12) * 20, atol=8)
    assert np.allclose(frames[-1][:, -1], frames[-1][0, 0], atol=12), "the added edge is not of another colour"
    assert list(tmp_path.iterdir()) == [path]


def test_the_final_name_appears_only_at_the_end(tmp_path: Path, codec: str) -> None:
    path = tmp_path / "a.mp4"
    path.write_text("older")
    with VideoWriter(path, 25, (64, 48)) as writer:
        for frame in noise(5):
            writer.write(frame)
        assert path.read_text() == "older"
    assert len(read(path)) == 5


@pytest.mark.parametrize("error", [KeyboardInterrupt, UserError, RuntimeError])
def test_an_interrupted_video_keeps_its_frames(tmp_path: Path, codec: str, error: type[BaseException]) -> None:
    path = tmp_path / "a.mp4"
    with pytest.raises(error), VideoWriter(path, 25, (64, 48)) as writer:
        for frame in noise(7):
            writer.write(frame)
        raise error("stop")
    assert len(read(path)) == 7
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_a_frame_can_be_held(tmp_path: Path, codec: str, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    with VideoWriter(path, 25, (64, 48)) as writer:
        writer.write(noise(1)[0])
        writer.hold(48)
        writer.write(noise(1)[0])
    video = cv2.VideoCapture(str(path))
    times = []
    while video.read()[0]:
        times.append(video.get(cv2.CAP_PROP_POS_MSEC))
    # 49 frames after the first, of 40 ms each
    assert times[-1] - times[0] == pytest.approx(49 * 40, abs=2)


def test_without_a_frame_nothing_is_left(tmp_path: Path, codec: str) -> None:
    with VideoWriter(tmp_path / "a.mp4", 25, (64, 48)):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "fps", "size", "message"),
    [
        ("a.wmv", 25, (64, 48), r"unknown format: .*\.mp4"),
        ("a", 25, (64, 48), "unknown format"),
        ("missing/a.mp4", 25, (64, 48), "cannot be written"),
        ("folder.mp4", 25, (64, 48), "a folder has that name"),
        ("a.mp4", 0, (64, 48), "give more than 0"),
        ("a.mp4", float("nan"), (64, 48), "give more than 0"),
        ("a.mp4", 25, (0, 48), "give more than 0"),
    ],
)
def test_what_cannot_be_written_is_refused_at_once(
    tmp_path: Path, name: str, fps: float, size: tuple[int, int], message: str
) -> None:
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(UserError, match=message) as caught:
        VideoWriter(tmp_path / name, fps, size)
    assert str(tmp_path / name) in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["folder.mp4"]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(UserError, match="cannot be written"):
        VideoWriter(tmp_path / "a.mp4", 25, (64, 48))


def test_a_frame_of_another_size_is_refused_and_the_rest_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with pytest.raises(UserError, match="48x64 does not fit"), VideoWriter(path, 25, (64, 48)) as writer:
        writer.write(noise(1)[0])
        writer.write(noise(1, 48, 64)[0])
    assert len(read(path)) == 1


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
def test_a_full_disk_is_told_and_leaves_nothing(tmp_path: Path, codec: str, suffix: str, refused_on: Any) -> None:
    refused_on(200_000, tmp_path / f"a{suffix}", "")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("older", [False, True])
def test_matroska_on_a_full_disk_keeps_what_was_written(
    tmp_path: Path, codec: str, older: bool, refused_on: Any
) -> None:
    path = tmp_path / "a.mkv"
    kept = tmp_path / "a.cut.mkv" if older else path
    if older:
        path.write_text("older")
    refused_on(1_000_000, path, f": .*; what was written until then is in {kept}$")
    assert sorted(tmp_path.iterdir()) == sorted({path, kept})
    assert not older or path.read_text() == "older"
    count = len(read(kept))
    # noise of this size takes some 40,000 bytes per frame in H.264, less in MPEG-4
    assert 10 < count < 80


@pytest.mark.slow
@pytest.mark.parametrize("fps", [5, 30])
def test_matroska_survives_a_kill_but_for_the_last_second(tmp_path: Path, fps: int) -> None:
    pytest.importorskip("av")
    count = 4 * fps
    program = f"""
import os, signal
import numpy as np
from psiamfcpp.video.writer import VideoWriter
writer = VideoWriter({str(tmp_path / "a.mkv")!r}, {fps}, (320, 240))
for number in range({count}):
    writer.write(np.full((240, 320, 3), number % 200, np.uint8))
os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", program]).returncode == -9
    (left,) = tmp_path.iterdir()
    assert left.suffix == ".mkv"
    assert count - fps <= len(read(left)) <= count


def test_a_second_interruption_leaves_no_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, codec: str) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    for suffix in (".mp4", ".mkv"):
        with pytest.raises(KeyboardInterrupt), VideoWriter(tmp_path / f"a{suffix}", 25, (64, 48)) as writer:
            for frame in noise(30):
                writer.write(frame)
            monkeypatch.setattr(writer._encoder, "finish", interrupt)
            raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["a.mkv"]
