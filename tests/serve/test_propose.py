"""A tap becomes a box."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from psiamfcpp.demo.clip import render
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, overlap
from psiamfcpp.serve.propose import propose_box


@pytest.mark.parametrize("box", [(100, 80, 40, 30), (300, 200, 24, 50), (2, 2, 30, 30), (590, 440, 40, 30)])
@pytest.mark.parametrize("off", [(0.5, 0.5), (0.3, 0.6)])
def test_a_blob_is_found_wherever_in_it_one_taps(
    blob_frame: Callable[..., Any], box: Box, off: tuple[float, float]
) -> None:
    frame = blob_frame(box, width=640, height=480)
    x, y, w, h = box
    assert overlap(propose_box(frame, x + off[0] * w, y + off[1] * h), box) > 0.8


@pytest.mark.slow
def test_a_car_from_above_is_found() -> None:
    shot = next(iter(render(0, 2)))
    x, y, w, h = shot.box
    assert overlap(propose_box(shot.image, x + w / 2, y + h / 2), shot.box) > 0.5


def test_bare_ground_gives_a_small_square_about_the_point() -> None:
    frame = np.random.default_rng(0).integers(90, 110, (480, 640, 3), dtype=np.uint8)
    x, y, w, h = propose_box(frame, 300, 200)
    assert abs(x + (w - 1) / 2 - 300) < 40
    assert abs(y + (h - 1) / 2 - 200) < 40
    assert 4 <= min(w, h) <= max(w, h) < 90


@pytest.mark.parametrize("point", [(-1, 5), (5, 480), (float("nan"), 5), (5, float("inf"))])
def test_points_outside_are_refused(point: tuple[float, float]) -> None:
    with pytest.raises(UserError, match=r"point .* lies outside the frame \(640x480\)"):
        propose_box(np.zeros((480, 640, 3), np.uint8), *point)


@pytest.mark.parametrize("shape", [(8, 8, 3), (20, 300, 3), (2160, 3840, 3)])
def test_frames_of_any_size_are_taken(shape: tuple[int, int, int]) -> None:
    frame = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
    for point in ((0, 0), (shape[1] - 1, shape[0] - 1), (shape[1] // 2, shape[0] // 2)):
        x, y, w, h = propose_box(frame, *point)
        assert min(w, h) > 0
        assert x - 1 <= point[0] <= x + w and y - 1 <= point[1] <= y + h
