"""The motion of the camera, from frames whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from psiamfcpp.geometry import Image
from psiamfcpp.trackers.siamfcpp.camera import STILL, Camera, moved
from psiamfcpp.trackers.siamfcpp.procedure import Target

NOWHERE = Target(-100, -100, 2, 2)


@pytest.fixture(scope="module")
def ground() -> Image:
    """An even mixture of small and large bumps, wider than the frames cut from it."""
    rng = np.random.default_rng(4)
    bumps = sum(
        cv2.resize(rng.normal(0, 30, (cells, cells, 3)), (1200, 1200), interpolation=cv2.INTER_CUBIC)
        for cells in (20, 60, 200)
    )
    return np.clip(128 + bumps, 0, 255).astype(np.uint8)


def view(ground: Image, motion: np.ndarray) -> Image:
    """What a camera of 640x360 sees after a motion."""
    start = np.array([[1.0, 0, -200], [0, 1, -300], [0, 0, 1]])
    return np.asarray(cv2.warpAffine(ground, motion @ start, (640, 360)), np.uint8)


@pytest.mark.parametrize(
    ("zoom", "angle", "shift"), [(1, 0, (0, 0)), (1, 0, (7.5, -4)), (1.02, 0, (0, 3)), (0.98, 0.02, (-12, 5))]
)
def test_a_motion_is_found(ground: Image, zoom: float, angle: float, shift: tuple[float, float]) -> None:
    cos, sin = zoom * np.cos(angle), zoom * np.sin(angle)
    motion = np.array([[cos, -sin, shift[0]], [sin, cos, shift[1]]])
    camera = Camera()
    assert camera.step(view(ground, STILL), NOWHERE) is STILL
    frame = np.minimum(view(ground, motion), 254) + 1
    found = camera.step(frame, NOWHERE)
    assert found is not None
    place = moved(Target(320, 180, 40, 30), found)
    true = moved(Target(320, 180, 40, 30), motion)
    assert (place.cx, place.cy, place.w, place.h) == pytest.approx((true.cx, true.cy, true.w, true.h), abs=0.6)


def test_what_moves_in_the_box_is_left_out(ground: Image) -> None:
    other, camera = ground[::-1, ::-1], Camera()
    frames = [view(ground, STILL), view(ground, np.array([[1.0, 0, 3], [0, 1, 0]]))]
    for number, frame in enumerate(frames):
        left = 60 + 6 * number
        frame[20:340, left : left + 380] = other[20:340, 100:480]
    camera.step(frames[0], Target(250, 180, 420, 340))
    found = camera.step(frames[1], Target(250, 180, 420, 340))
    assert found is not None
    assert found[:, 2] == pytest.approx((3, 0), abs=0.7)


def test_what_moves_against_the_camera_is_found(ground: Image) -> None:
    camera = Camera()
    assert camera.movers(30) == []
    for number in range(2):
        frame = view(ground, np.array([[1.0, 0, 5.0 * number], [0, 1, 0]]))
        for x, y in ((100 + 20 * number, 80), (500, 250 - 20 * number)):
            frame[y - 15 : y + 15, x - 15 : x + 15] = 255
        camera.step(frame, NOWHERE)
    places = camera.movers(30)
    for x, y in ((120, 80), (500, 230)):
        assert min(np.hypot(x - u, y - v) for u, v in places[:3]) < 40


def test_a_cut_is_no_motion_and_a_repeated_frame_says_so(ground: Image) -> None:
    camera, first = Camera(), view(ground, STILL)
    camera.step(first, NOWHERE)
    assert camera.step(view(ground[::-1, ::-1].copy(), STILL), NOWHERE) is STILL
    assert camera.step(view(ground[::-1, ::-1].copy(), STILL), NOWHERE) is None
    camera.forget()
    assert camera.step(first, NOWHERE) is STILL


def test_a_frame_of_another_size_begins_anew(ground: Image) -> None:
    camera = Camera()
    camera.step(view(ground, STILL), NOWHERE)
    assert camera.step(view(ground, STILL)[:200], NOWHERE) is STILL
