"""Several targets: each followed as if it were alone, all searched for at once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from psiamfcpp import TargetPool, Tracker, UserError
from psiamfcpp.geometry import Box, Image, centre_error
from psiamfcpp.runtime import open_engine

Draw = Callable[..., Image]
# So far apart that no search region (about 270 pixels wide) of one holds the other.
A: Box = (60, 60, 40, 30)
B: Box = (520, 380, 30, 40)
C: Box = (60, 380, 30, 30)


def scene(draw: Draw, *boxes: Box) -> Image:
    return np.maximum.reduce([draw(box, width=640, height=480) for box in boxes])


def moved(box: Box, dx: float, dy: float) -> Box:
    return (box[0] + dx, box[1] + dy, *box[2:])


def test_targets_that_part_are_followed_each(blob_engine: Any, blob_frame: Draw) -> None:
    pool = TargetPool()
    first = scene(blob_frame, A, B, C)
    assert [pool.add(first, box)[0] for box in (A, B, C)] == [1, 2, 3]
    for t in range(1, 8):
        truth = {1: moved(A, 3 * t, t), 2: moved(B, -2 * t, -t), 3: moved(C, 2 * t, 0)}
        tracks = pool.update(scene(blob_frame, *truth.values()))
        assert list(tracks) == [1, 2, 3]
        for number, track in tracks.items():
            assert track.state == "tracking"
            assert centre_error(track.box, truth[number]) < 1
    # one call a frame, every region with the kernels of its own target
    assert blob_engine.batches == [[1, 2, 3]] * 7


def test_each_target_has_a_state_of_its_own(blob_engine: Any, blob_frame: Draw) -> None:
    pool = TargetPool()
    for box in (A, B):
        pool.add(scene(blob_frame, A, B), box)
    for t in range(10):
        tracks = pool.update(scene(blob_frame, moved(B, t % 2, 0)))
    assert [track.state for track in tracks.values()] == ["lost", "tracking"]


def test_targets_come_and_go_while_others_are_followed(blob_engine: Any, blob_frame: Draw) -> None:
    pool, frame = TargetPool(), scene(blob_frame, A, B, C)
    assert pool.update(frame) == {}
    pool.add(frame, A)
    pool.add(frame, B)
    pool.update(frame)
    pool.remove(1)
    pool.remove(99)
    # a number is never given twice
    assert pool.add(frame, C)[0] == 3
    tracks = pool.update(frame)
    assert list(tracks) == pool.numbers == [2, 3]
    assert centre_error([tracks[2].box, tracks[3].box], [B, C]).max() < 1
    pool.remove(2)
    pool.remove(3)
    assert pool.update(frame) == {}


def test_a_refused_box_costs_no_number_and_no_target(blob_engine: Any, blob_frame: Draw) -> None:
    pool, frame = TargetPool(), scene(blob_frame, A)
    pool.add(frame, A)
    with pytest.raises(UserError, match="outside the frame"):
        pool.add(frame, (5000, 10, 20, 20))
    assert pool.numbers == [1]
    assert centre_error(pool.update(frame)[1].box, A) < 1
    with pytest.raises(UserError, match="frame is NoneType"):
        pool.update(None)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize("plain", [False, True])
def test_a_pool_says_what_trackers_alone_would_say(tiny_model: Path, plain: bool) -> None:
    rng = np.random.default_rng(3)
    frames = rng.integers(0, 256, (4, 240, 320, 3), dtype=np.uint8)
    boxes: list[Box] = [(30, 40, 50, 40), (200, 120, 30, 60), (150, 30, 80, 20)]
    pool = TargetPool(str(tiny_model), threads=1, plain=plain)
    alone = [Tracker(str(tiny_model), threads=1, plain=plain) for _ in boxes]
    for tracker, box in zip(alone, boxes, strict=True):
        assert pool.add(frames[0], box)[1] == tracker.init(frames[0], box)
    for frame in frames[1:]:
        together = list(pool.update(frame).values())
        single = [tracker.update(frame) for tracker in alone]
        assert_allclose([t.box for t in together], [t.box for t in single], rtol=1e-3, atol=0.05)
        assert_allclose([t.score for t in together], [t.score for t in single], atol=1e-4)
        assert [t.state for t in together] == [t.state for t in single]


def test_a_batched_search_is_the_single_ones(tiny_model: Path) -> None:
    engine = open_engine(str(tiny_model), threads=1)
    rng = np.random.default_rng(1)
    templates = rng.integers(0, 256, (3, 127, 127, 3), dtype=np.uint8)
    crops = rng.integers(0, 256, (3, 303, 303, 3), dtype=np.uint8)
    kernels = [engine.template(z) for z in templates]
    scores, boxes = engine.search_many(crops, kernels)
    assert (scores.shape, boxes.shape) == ((3, 17, 17), (3, 17, 17, 4))
    for i in range(3):
        one_scores, one_boxes = engine.search(crops[i], kernels[i])
        assert_allclose(scores[i], one_scores, atol=1e-4)
        assert_allclose(boxes[i], one_boxes, rtol=1e-4, atol=1e-3)
