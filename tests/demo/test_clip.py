"""The demo clip: its truth is true, and the ride has what it promises."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from psiamfcpp.demo.clip import TARGET_COLOURS, DemoFrame, render
from psiamfcpp.errors import UserError

SMALL = (640, 360)


@pytest.fixture(scope="module")
def clip() -> list[DemoFrame]:
    return list(render(seed=3, frames=100, size=SMALL))


@pytest.mark.slow
def test_the_clip_has_the_frames_asked_for(clip: list[DemoFrame]) -> None:
    assert len(clip) == 100
    assert all(f.image.shape == (360, 640, 3) and f.image.dtype == np.uint8 for f in clip)


@pytest.mark.slow
def test_the_box_stays_inside_the_frame(clip: list[DemoFrame]) -> None:
    boxes = np.array([f.box for f in clip])
    assert (boxes[:, :2] >= 0).all()
    assert (boxes[:, :2] + boxes[:, 2:] <= SMALL).all()


@pytest.mark.slow
def test_the_target_is_hidden_once(clip: list[DemoFrame]) -> None:
    visible = np.array([f.visible for f in clip])
    assert 5 <= (~visible).sum() <= 9
    assert np.abs(np.diff(visible.astype(int))).sum() == 2
    assert visible[0] and visible[-1]


@pytest.mark.slow
def test_the_target_grows_and_shrinks(clip: list[DemoFrame]) -> None:
    sides = np.array([max(f.box[2:]) for f in clip])
    assert 16 < sides.min() < 20 and 30 < sides.max() < 35
    assert sides.argmin() not in (0, 99)


@pytest.mark.slow
def test_the_box_moves_smoothly(clip: list[DemoFrame]) -> None:
    boxes = np.array([f.box for f in clip])
    steps = np.abs(np.diff(boxes[:, :2] + boxes[:, 2:] / 2, axis=0))
    assert steps.max() < 18
    assert np.ptp(boxes[:, :2], axis=0).min() > 60


@pytest.mark.slow
def test_the_target_is_where_the_box_says(clip: list[DemoFrame]) -> None:
    first = _roof(clip[0])
    colour = min(TARGET_COLOURS, key=lambda c: float(np.abs(np.array(c) - first).sum()))
    off = [np.abs(_roof(f) - colour).max() for f in clip]
    seen = [o for o, f in zip(off, clip, strict=True) if f.visible]
    hidden = [o for o, f in zip(off, clip, strict=True) if not f.visible]
    assert np.quantile(seen, 0.95) < 60
    assert np.median(hidden) > 80


@pytest.mark.slow
def test_the_box_is_tight() -> None:
    # on a grey road the target is the only thing with a strong colour
    for frame in islice(render(seed=0, frames=40), 0, 40, 6):
        if not frame.visible:
            continue
        x, y, w, h = frame.box
        left, top = int(x) - 12, int(y) - 12
        crop = frame.image[top : top + int(h) + 24, left : left + int(w) + 24].astype(int)
        body = (crop.max(axis=2) - crop.min(axis=2) > 110).nonzero()
        middle = (np.array([body[1].min() + body[1].max(), body[0].min() + body[0].max()]) + 1) / 2 + (
            left,
            top,
        )
        size = np.array([np.ptp(body[1]), np.ptp(body[0])]) + 1
        assert np.abs(middle - (x + w / 2, y + h / 2)).max() < 2.5
        assert np.abs(size - (w, h)).max() < 5


@pytest.mark.slow
def test_a_seed_gives_the_same_clip_and_another_seed_another(rendered_clip: list[DemoFrame]) -> None:
    def start(seed: int) -> list[DemoFrame]:
        return list(islice(render(seed, 20, (320, 192)), 3))

    one, same, other = rendered_clip[:3], start(3), start(2)
    for a, b in zip(one, same, strict=True):
        assert a.image.tobytes() == b.image.tobytes()
        assert (a.box, a.visible) == (b.box, b.visible)
    assert one[0].image.tobytes() != other[0].image.tobytes()
    assert one[0].box != other[0].box


@pytest.mark.parametrize(
    ("seed", "frames", "size", "message"),
    [
        (-1, 10, SMALL, "seed -1 is negative"),
        (0, 1, SMALL, "1 frames is too short"),
        (0, 10, (640, 20), "640x20 is too small"),
    ],
)
def test_bad_numbers_are_refused_at_once(seed: int, frames: int, size: tuple[int, int], message: str) -> None:
    with pytest.raises(UserError, match=message):
        render(seed, frames, size)


def _roof(frame: DemoFrame) -> np.ndarray:
    x, y, w, h = frame.box
    column, row = round(x + (w - 1) / 2), round(y + (h - 1) / 2)
    return np.median(frame.image[row - 1 : row + 2, column - 1 : column + 2].astype(int), axis=(0, 1))
