"""Frames whose size or colour changes while a target is followed, and targets that leave."""

import numpy as np
import pytest

pytest.importorskip("scipy")
pytest.importorskip("numba")

from psiamfcpp.trackers.dcf import FILTERS, open_dcf

SIZE = (90, 110)


def frames(count: int, by: tuple[int, int] = (1, 1)) -> list[np.ndarray]:
    """Smooth colour noise that moves by ``by`` (rows, columns) a frame."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    found = []
    for i in range(count):
        v, u = y - by[0] * i, x - by[1] * i
        waves = [np.sin(0.31 * u + 0.17 * v), np.cos(0.23 * u - 0.37 * v), np.sin(0.11 * u * np.cos(0.05 * v))]
        found.append((127 + 120 * np.stack(waves, axis=2)).astype(np.uint8))
    return found


def boxes(name: str, clip: list[np.ndarray], start: tuple[float, ...] = (40, 30, 22, 18)) -> np.ndarray:
    tracker = open_dcf(name)
    tracker.init(clip[0], start)
    return np.array([tracker.update(frame).box for frame in clip[1:]])


CHANGES = {
    "smaller": lambda f: f[:50, :60],
    "larger": lambda f: np.repeat(np.repeat(f, 2, axis=0), 2, axis=1),
    "one-pixel": lambda f: f[:1, :1],
    "grey": lambda f: np.repeat(f[..., :1], 3, axis=2),
    "black": np.zeros_like,
    "not-contiguous": lambda f: f[:, ::-1],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
def test_a_frame_of_another_kind_in_between_gives_finite_boxes(name):
    for what, change in CHANGES.items():
        clip = frames(5)
        clip[2] = change(clip[2])
        found = boxes(name, clip)
        assert np.isfinite(found).all(), what
        assert (found[:, 2:] > 0).all(), what


@pytest.mark.parametrize("name", FILTERS)
def test_colour_after_a_grey_first_frame_is_read_as_grey(name):
    clip = frames(4)
    clip[0] = np.repeat(clip[0][..., 1:2], 3, axis=2)
    assert np.isfinite(boxes(name, clip)).all()


@pytest.mark.parametrize("name", FILTERS)
def test_a_target_that_leaves_the_frame_gives_finite_boxes(name):
    for by in ((-9, -13), (11, 8)):
        found = boxes(name, frames(12, by))
        assert np.isfinite(found).all(), by
        assert (found[:, 2:] > 0).all(), by
