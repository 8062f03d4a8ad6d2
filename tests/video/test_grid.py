"""Coordinates over a frame."""

from __future__ import annotations

import numpy as np
import pytest

from psiamfcpp.video.grid import draw_grid, grid_step


@pytest.mark.parametrize(
    ("width", "height", "step"),
    [(320, 240, 50), (640, 360, 50), (1280, 720, 100), (1920, 1080, 200), (3840, 2160, 250)],
)
def test_lines_are_round_numbers_apart_and_labels_have_room(width: int, height: int, step: int) -> None:
    assert grid_step(width, height) == step


@pytest.mark.parametrize("shade", [0, 90, 128, 255])
def test_lines_are_seen_on_any_ground(shade: int) -> None:
    frame = np.full((360, 640, 3), shade, np.uint8)
    image = draw_grid(frame).astype(int)
    assert abs(image[125, 300] - shade).min() > 30
    assert abs(image[125, 310] - shade).min() > 10
    assert (image[125, 305] == shade).all()
    assert (frame == shade).all()


@pytest.mark.parametrize("size", [(1, 1), (8, 300), (30, 30)])
def test_frames_of_any_size_keep_it(size: tuple[int, int]) -> None:
    assert draw_grid(np.zeros((*size, 3), np.uint8)).shape == (*size, 3)
