"""Image files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from psiamfcpp.errors import UserError
from psiamfcpp.images import ImageReader, _is_damaged_png, image_files, is_readable, read_image


def test_read_image_gives_bgr_bytes(tmp_path: Path):
    path = tmp_path / "red.png"
    cv2.imwrite(str(path), np.full((2, 3, 3), (0, 0, 255), dtype=np.uint8))
    image = read_image(path)
    assert image.shape == (2, 3, 3)
    assert image.dtype == np.uint8
    assert image[0, 0].tolist() == [0, 0, 255]


def test_read_image_makes_three_channels_of_a_grey_one(tmp_path: Path):
    path = tmp_path / "grey.png"
    cv2.imwrite(str(path), np.full((2, 3), 7, dtype=np.uint8))
    assert read_image(path).tolist() == [[[7, 7, 7]] * 3] * 2


def test_read_image_missing(tmp_path: Path):
    with pytest.raises(UserError, match=r"image .*gone\.png does not exist"):
        read_image(tmp_path / "gone.png")


def test_read_image_damaged(tmp_path: Path):
    path = tmp_path / "bad.png"
    path.write_bytes(b"not an image")
    with pytest.raises(UserError, match=r"image .*bad\.png cannot be read"):
        read_image(path)


def counts_of(grey: NDArray[Any], kind: str) -> NDArray[Any]:
    """Grey levels as cameras write them: 14 bits, the lowest counts of 16, degrees with holes."""
    if kind == "thermal":
        return grey.astype(np.uint16) * 8 + 7000
    if kind == "low":
        return grey.astype(np.uint16)
    values = grey.astype(np.float32) / 10 + 270
    values[0, 0], values[1, 1] = np.nan, np.inf
    return values


@pytest.mark.parametrize(("kind", "suffix"), [("thermal", "png"), ("low", "png"), ("low", "tif"), ("degrees", "tif")])
def test_more_than_8_bits_are_stretched_by_the_first_image_with_contrast(
    tmp_path: Path, kind: str, suffix: str
) -> None:
    ramp = np.tile(np.arange(64, 192, dtype=np.uint8), (32, 1))
    greys = [np.full_like(ramp, 100), ramp, np.clip(ramp + 20, 0, 200), ramp]
    reader, images = ImageReader(), []
    for number, grey in enumerate(greys):
        path = tmp_path / f"{number}.{suffix}"
        assert cv2.imwrite(str(path), counts_of(grey, kind))
        images.append(reader.read(path))
    assert all(image.dtype == np.uint8 and image.shape == (32, 128, 3) for image in images)
    first = images[1][16, :, 0].astype(int)
    assert (first[0], first[-1]) == (0, 255)
    assert (np.diff(first) >= 0).all()
    assert len(set(first)) > 100
    # the same count is the same grey in all, and what is brighter is cut off
    assert np.array_equal(images[3][8:], images[1][8:])
    assert images[2][16, 0, 0] == pytest.approx(first[20], abs=1)
    assert images[2][16, -1, 0] == 255


def test_8_bits_stay_as_they_are(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(60, 90, (20, 30, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    assert np.array_equal(read_image(tmp_path / "a.png"), image)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "endless.png").symlink_to("/dev/zero")
    for name in ("pipe.png", "folder.png", "endless.png"):
        with pytest.raises(UserError, match=f"{name} is not a file"):
            read_image(tmp_path / name)
    for strange in ("a\0b.png", "x" * 5000 + ".png"):
        with pytest.raises(UserError, match="cannot be read"):
            read_image(Path(strange))


def test_names_that_are_not_utf8_are_read(tmp_path: Path) -> None:
    image = np.full((4, 5, 3), 9, np.uint8)
    path = tmp_path / os.fsdecode(b"\xff\xfe.png")
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    assert np.array_equal(read_image(path), image)


def test_image_files_come_in_natural_order_without_what_is_no_image(tmp_path: Path) -> None:
    names = ["10.jpg", "2.JPG", "a.webp", "notes.txt", "._2.jpg", "b.jpeg"]
    assert [p.name for p in image_files(tmp_path / n for n in names)] == ["2.JPG", "10.jpg", "a.webp", "b.jpeg"]


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp"])
def test_cut_images_are_not_readable(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8))
    assert is_readable(path)
    path.write_bytes(path.read_bytes()[:20])
    assert not is_readable(path)
    path.write_bytes(b"")
    assert not is_readable(path)
    assert not is_readable(tmp_path / "gone.png")
    assert not is_readable(tmp_path)


@given(st.integers(0, 2000), st.integers(1, 255))
def test_a_damaged_png_is_refused_without_a_word_of_the_decoder(at: int, change: int) -> None:
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    data = bytearray(cv2.imencode(".png", image)[1].tobytes())
    data[at % len(data)] ^= change
    assert _is_damaged_png(bytes(data)) or not data.startswith(b"\x89PNG\r\n\x1a\n")
    assert not _is_damaged_png(cv2.imencode(".png", image)[1].tobytes())
