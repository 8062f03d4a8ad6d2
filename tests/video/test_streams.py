"""Containers with more in them than one video stream: covers, thumbnails, previews, much sound."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.video.source import open_source
from psiamfcpp.video.streams import has_sound

av = pytest.importorskip("av")

COUNT, WIDTH, HEIGHT = 20, 320, 240


def video(width: int = WIDTH, height: int = HEIGHT) -> Iterator[Image]:
    """Frames that tell their number by their grey level."""
    for number in range(COUNT):
        yield np.full((height, width, 3), 50 + 8 * number, np.uint8)


def numbers(path: Path) -> list[int]:
    """The numbers of the frames that are read."""
    with open_source(path) as source:
        assert source.fps == 25
        frames = list(source)
    assert {frame.shape for frame in frames} == {(HEIGHT, WIDTH, 3)}
    return [round((float(frame.mean()) - 50) / 8) for frame in frames]


def add(out: Any, codec: str, rate: int, width: int, height: int) -> Any:
    stream = out.add_stream(codec, rate=rate)
    stream.width, stream.height = width, height
    stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    return stream


def write(out: Any, stream: Any, images: Iterator[Image]) -> None:
    for number, image in enumerate(images):
        frame = av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format=stream.pix_fmt)
        frame.pts, frame.time_base = number, 1 / stream.codec_context.framerate
        out.mux(stream.encode(frame))
    out.mux(stream.encode(None))


def grey_image(width: int, height: int, count: int = 1) -> Iterator[Image]:
    return (np.full((height, width, 3), 128, np.uint8) for _ in range(count))


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
@pytest.mark.parametrize("cover_first", [True, False])
@pytest.mark.parametrize(("width", "height", "count"), [(160, 120, 1), (1280, 720, 1), (640, 480, 2)])
def test_an_image_beside_the_video_is_not_the_video(
    tmp_path: Path, suffix: str, cover_first: bool, width: int, height: int, count: int
) -> None:
    path = tmp_path / f"a.{suffix}"
    with av.open(str(path), "w") as out:
        if cover_first:
            cover = add(out, "mjpeg", 1, width, height)
        main = add(out, "libx264", 25, WIDTH, HEIGHT)
        if not cover_first:
            cover = add(out, "mjpeg", 1, width, height)
        write(out, cover, grey_image(width, height, count))
        write(out, main, video())
    assert numbers(path) == list(range(COUNT))


def atoms(data: bytes, at: int) -> Iterator[tuple[bytes, bytes]]:
    while at < len(data):
        size, kind = struct.unpack(">I4s", data[at : at + 8])
        yield kind, data[at : at + size]
        at += size


def test_a_cover_that_stands_before_the_tracks_is_not_the_video(tmp_path: Path) -> None:
    late = tmp_path / "late.mp4"
    with av.open(str(late), "w") as out:
        main, cover = add(out, "libx264", 25, WIDTH, HEIGHT), add(out, "mjpeg", 1, 160, 120)
        cover.disposition = av.stream.Disposition.attached_pic
        write(out, cover, grey_image(160, 120))
        write(out, main, video())
    assert numbers(late) == list(range(COUNT))
    # as some drones write it
    whole = b""
    for kind, atom in atoms(late.read_bytes(), 0):
        if kind == b"moov":
            parts = sorted(atoms(atom, 8), key=lambda part: [b"mvhd", b"udta", b"trak"].index(part[0]))
            atom = atom[:8] + b"".join(part for _, part in parts)
        whole += atom
    path = tmp_path / "cover.mp4"
    path.write_bytes(whole)
    assert numbers(path) == list(range(COUNT))


@pytest.mark.parametrize("preview_first", [True, False])
def test_of_a_preview_and_its_video_the_larger_is_read(tmp_path: Path, preview_first: bool) -> None:
    path = tmp_path / "a.mkv"
    sizes = [(160, 120), (WIDTH, HEIGHT)][:: 1 if preview_first else -1]
    with av.open(str(path), "w") as out:
        for stream, size in [(add(out, "libx264", 25, *size), size) for size in sizes]:
            write(out, stream, video(*size))
    assert numbers(path) == list(range(COUNT))


@pytest.mark.slow
def test_a_stream_that_is_cut_off_says_so(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    rng = np.random.default_rng(0)
    with av.open(str(path), "w") as out:
        cover, main = add(out, "mjpeg", 1, 160, 120), add(out, "libx264", 25, WIDTH, HEIGHT)
        write(out, cover, grey_image(160, 120))
        write(out, main, (rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(40)))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with open_source(path) as source, pytest.raises(UserError, match=r"cut off: \d+ of 4\d frames"):
        list(source)


@pytest.mark.slow
def test_without_pyav_a_cover_is_no_video_without_a_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "cover.mp4"
    with av.open(str(path), "w") as out:
        cover, main = add(out, "mjpeg", 1, 160, 120), add(out, "libx264", 25, WIDTH, HEIGHT)
        write(out, cover, grey_image(160, 120))
        rng = np.random.default_rng(0)
        write(out, main, (rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(COUNT)))
    monkeypatch.setattr("psiamfcpp.video.source.open_other_stream", lambda _: None)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with open_source(path) as source, pytest.raises(UserError, match=r"more than .* pip install 'psiamfcpp\[video\]'"):
        list(source)


@pytest.mark.slow
def test_an_image_that_stands_still_beside_its_sound_is_not_the_end(tmp_path: Path) -> None:
    path = tmp_path / "pause.mp4"
    with av.open(str(path), "w") as out:
        main = add(out, "libx264", 25, WIDTH, HEIGHT)
        main.options = {"bf": "0", "tune": "zerolatency"}
        main.codec_context.time_base = Fraction(1, 1000)
        audio, heard = out.add_stream("aac", rate=48000, layout="mono"), 0
        for number, image in enumerate(video()):
            ms = 40 * number + (120_000 if number > 9 else 0)
            while heard < 48 * ms:
                sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
                sound.sample_rate, sound.pts, sound.time_base = 48000, heard, Fraction(1, 48000)
                heard += 1024
                out.mux(audio.encode(sound))
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts, frame.time_base = ms, Fraction(1, 1000)
            out.mux(main.encode(frame))
        out.mux(main.encode(None))
        out.mux(audio.encode(None))
    with open_source(path) as source:
        assert [round((float(frame.mean()) - 50) / 8) for frame in source] == list(range(COUNT))


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_sound_that_goes_on_after_the_last_image_is_no_cut(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    with av.open(str(path), "w") as out:
        main, audio = add(out, "libx264", 25, WIDTH, HEIGHT), out.add_stream("aac", rate=48000, layout="mono")
        for number in range(3 * 48000 // 1024):
            sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            sound.sample_rate, sound.pts, sound.time_base = 48000, 1024 * number, Fraction(1, 48000)
            out.mux(audio.encode(sound))
        write(out, main, video())
        out.mux(audio.encode(None))
    assert numbers(path) == list(range(COUNT))


def test_a_thermal_video_keeps_its_grey_levels(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    ramp = np.tile(np.arange(WIDTH, dtype=np.uint16), (HEIGHT, 1)) + 7000
    with av.open(str(path), "w") as out:
        stream = out.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray16le"
        for number in range(3):
            frame = av.VideoFrame.from_ndarray(ramp + 10 * number, format="gray16le")
            frame.pts, frame.time_base = number, Fraction(1, 25)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    with open_source(path) as source:
        frames = list(source)
    assert len(frames) == 3
    for number, frame in enumerate(frames):
        # 320 counts are stretched over 256 levels, the same in all frames
        expected = np.clip((np.arange(WIDTH) + 10 * number) * 255 / 319, 0, 255)
        assert np.allclose(frame[5, :, 1], expected, atol=1.5)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_turned_videos_are_turned_by_both_readers(tmp_path: Path, quarters: int) -> None:
    from psiamfcpp.video import streams

    rng = np.random.default_rng(0)
    image = cv2.resize(rng.integers(0, 255, (6, 8, 3), dtype=np.uint8), (WIDTH, HEIGHT))
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as out:
        write(out, add(out, "libx264", 25, WIDTH, HEIGHT), iter([image] * 3))
    data = bytearray(path.read_bytes())
    one, less = 0x10000, 0xFFFF0000
    matrix = {
        1: (0, one, 0, less, 0, 0, HEIGHT * one, 0, 1 << 30),
        2: (less, 0, 0, 0, less, 0, WIDTH * one, HEIGHT * one, 1 << 30),
        3: (0, less, 0, one, 0, 0, 0, WIDTH * one, 1 << 30),
    }[quarters]
    at = data.index(b"tkhd") + 44
    data[at : at + 36] = struct.pack(">9I", *matrix)
    path.write_bytes(data)
    with open_source(path) as source:
        expected = next(source)
    assert expected.shape == ((WIDTH, HEIGHT, 3) if quarters % 2 else (HEIGHT, WIDTH, 3))
    with av.open(str(path)) as container:
        found, _ = next(streams._frames(av, container, container.streams.video[0], False))
    assert np.array_equal(found, expected)


@pytest.mark.parametrize("sound", [True, False])
def test_a_sound_track_is_noticed(tmp_path: Path, sound: bool) -> None:
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as out:
        main = add(out, "libx264", 25, WIDTH, HEIGHT)
        audio = out.add_stream("aac", rate=48000, layout="mono") if sound else None
        out.mux(main.encode(av.VideoFrame.from_ndarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8), format="bgr24")))
        if audio is not None:
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            frame.sample_rate, frame.pts, frame.time_base = 48000, 0, Fraction(1, 48000)
            out.mux(audio.encode(frame))
            out.mux(audio.encode(None))
        out.mux(main.encode(None))
    assert has_sound(str(path)) is sound


@pytest.mark.parametrize("source", ["0", "missing.mp4", "rtsp://host/a", "a ! b", "x" * 5000])
def test_what_is_no_file_has_no_sound_track(source: str) -> None:
    assert not has_sound(source)
