"""Image files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.images import image_files, read_image


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


def test_image_files_come_in_natural_order_without_what_is_no_image(tmp_path: Path) -> None:
    names = ["10.jpg", "2.JPG", "a.webp", "notes.txt", "._2.jpg", "b.jpeg"]
    assert [p.name for p in image_files(tmp_path / n for n in names)] == ["2.JPG", "10.jpg", "a.webp", "b.jpeg"]
