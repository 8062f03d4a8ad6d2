"""Frames that are kept for a box that is being drawn."""

from __future__ import annotations

import numpy as np
import pytest

from psiamfcpp.serve.ring import HOLD_S, Ring, stepping_stones


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def frame(number: int, side: int = 10) -> np.ndarray:
    return np.full((side, side, 3), number % 256, np.uint8)


def fill(ring: Ring, first: int, last: int) -> None:
    for number in range(first, last + 1):
        ring.add(number, frame(number))


def numbers(ring: Ring, since: int) -> list[int]:
    return [number for number, _ in ring.since(since)]


def test_the_newest_frames_are_kept_and_older_ones_are_gone() -> None:
    ring = Ring(most_bytes=10 * 300)
    fill(ring, 1, 25)
    assert numbers(ring, 16) == list(range(16, 26))
    assert numbers(ring, 15) == []
    assert numbers(ring, 26) == []
    assert not ring.hold("a", 15)


def test_a_held_frame_stays_with_a_chain_to_the_newest() -> None:
    ring = Ring(most_bytes=10 * 300)
    fill(ring, 1, 10)
    assert ring.hold("a", 5)
    fill(ring, 11, 500)
    chain = numbers(ring, 5)
    assert (chain[0], chain[-1]) == (5, 500)
    assert 5 <= len(chain) <= 10
    assert chain == sorted(set(chain))
    ring.release("a")
    fill(ring, 501, 520)
    assert numbers(ring, 5) == []
    assert numbers(ring, 511) == list(range(511, 521))


def test_each_holder_has_one_frame() -> None:
    ring = Ring(most_bytes=10 * 300)
    fill(ring, 1, 10)
    ring.hold("a", 3)
    ring.hold("b", 6)
    fill(ring, 11, 60)
    assert numbers(ring, 3)[0] == 3 and numbers(ring, 6)[0] == 6
    ring.hold("a", 60)
    fill(ring, 61, 100)
    assert numbers(ring, 3) == [] and numbers(ring, 6)[0] == 6 and numbers(ring, 60)[0] == 60


def test_a_hold_that_nobody_ends_runs_out() -> None:
    clock = Clock()
    ring = Ring(most_bytes=10 * 300, clock=clock)
    fill(ring, 1, 10)
    ring.hold("a", 5)
    clock.now = HOLD_S + 1
    fill(ring, 11, 40)
    assert numbers(ring, 5) == []


def test_frames_too_large_for_it_are_still_a_few() -> None:
    ring = Ring(most_bytes=100)
    fill(ring, 1, 9)
    assert numbers(ring, 6) == [6, 7, 8, 9]
    ring.clear()
    assert numbers(ring, 9) == []


@pytest.mark.parametrize(("count", "most", "expected"), [(0, 3, []), (2, 3, [1, 2]), (9, 3, [3, 6, 9]), (5, 1, [5])])
def test_stepping_stones_end_with_the_newest(count: int, most: int, expected: list[int]) -> None:
    frames = [(number, frame(number)) for number in range(1, count + 1)]
    assert [int(image[0, 0, 0]) for image in stepping_stones(frames, most)] == expected
