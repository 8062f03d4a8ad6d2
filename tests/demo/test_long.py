"""Long clips: the target leaves, is hidden and comes back, and the truth says so."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from psiamfcpp import UserError
from psiamfcpp.demo.long import render_long


@pytest.mark.slow
def test_the_target_goes_out_of_sight_and_comes_back() -> None:
    size = (160, 96)
    frames, again = list(render_long(2, 240, size)), render_long(2, 240, size)
    assert all(f.image.shape == (96, 160, 3) and f.image.dtype == np.uint8 for f in frames)
    seen = [f.visible for f in frames]
    assert seen[0]
    changes = [(a, b) for a, b in pairwise(seen) if a != b]
    assert changes.count((True, False)) >= 2 and changes.count((False, True)) >= 2
    for frame in frames:
        x, y, w, h = frame.box
        assert not frame.visible or (0 <= x + w / 2 < 160 and 0 <= y + h / 2 < 96)
    for frame, _ in zip(frames, range(3), strict=False):
        same = next(again)
        assert (same.box, same.visible) == (frame.box, frame.visible)
        np.testing.assert_array_equal(same.image, frame.image)


@pytest.mark.parametrize(("seed", "frames"), [(-1, 300), (0, 100)])
def test_wrong_arguments_are_refused(seed: int, frames: int) -> None:
    with pytest.raises(UserError, match="no long clip of seed"):
        render_long(seed, frames)
