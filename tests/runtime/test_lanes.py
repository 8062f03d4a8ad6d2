"""Searches side by side: each target gets its own answer, and no thread is idle."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from psiamfcpp.runtime.lanes import Lanes, Search


def answer(crop: np.ndarray, kernels: int) -> tuple[Any, Any]:
    """Tells by its first number whose crop it was, and by its boxes whose kernels."""
    return np.full((3, 3), crop[0, 0, 0], np.float32), np.full((3, 3, 4), kernels, np.float32)


def crops(count: int) -> np.ndarray:
    return np.arange(count, dtype=np.uint8)[:, None, None, None] * np.ones((1, 4, 4, 3), np.uint8)


@pytest.mark.parametrize(
    ("threads", "targets", "rounds"),
    [
        (1, 4, [1, 1, 1, 1]),
        (2, 1, [1]),
        (2, 4, [2, 2]),
        (2, 3, [2, 1]),
        (3, 3, [3]),
        (4, 3, [2, 1]),  # three of four threads would leave one idle
        (4, 7, [4, 2, 1]),
        (6, 5, [3, 2]),
        (8, 2, [2]),
    ],
)
def test_threads_are_shared_out_evenly_and_answers_stay_in_order(threads: int, targets: int, rounds: list[int]) -> None:
    taken: list[int] = []
    opened: list[int] = []

    def counted(count: int) -> Search:
        def search(crop: Any, kernels: Any) -> tuple[Any, Any]:
            taken.append(count)
            return answer(crop, kernels)

        return search

    def open_lanes(count: int) -> list[Search]:
        opened.append(count)
        return [counted(count)] * count

    lanes = Lanes(threads, counted(1), open_lanes)
    for _ in range(2):
        taken.clear()
        scores, boxes = lanes.search_many(crops(targets), [10 * i for i in range(targets)])
        assert (scores.shape, boxes.shape) == ((targets, 3, 3), (targets, 3, 3, 4))
        assert scores[:, 0, 0].tolist() == list(range(targets))
        assert boxes[:, 0, 0, 0].tolist() == [10 * i for i in range(targets)]
        assert taken == [count for count in rounds for _ in range(count)]
    # lanes are opened when they are first needed, and kept
    assert opened == sorted({*rounds} - {1}, reverse=True)


def test_lanes_run_at_once() -> None:
    meeting = threading.Barrier(2, timeout=300)

    def search(crop: Any, kernels: Any) -> tuple[Any, Any]:
        meeting.wait()  # never passed by one alone
        return answer(crop, kernels)

    lanes = Lanes(2, search, lambda count: [search] * count)
    assert lanes.search_many(crops(4), [0, 1, 2, 3])[0][:, 0, 0].tolist() == [0, 1, 2, 3]


def test_a_search_that_fails_says_so() -> None:
    def broken(*_: Any) -> Any:
        raise RuntimeError("out of order")

    with pytest.raises(RuntimeError, match="out of order"):
        Lanes(2, broken, lambda count: [broken] * count).search_many(crops(2), [0, 1])
