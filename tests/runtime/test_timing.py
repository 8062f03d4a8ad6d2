"""Timing an engine: what is run, not how long it takes."""

from __future__ import annotations

import itertools
import time
from typing import Any

import numpy as np
import pytest

from psiamfcpp.runtime.timing import search_milliseconds
from psiamfcpp.spec import ModelSpec


def test_the_median_of_searches_alone_after_three_that_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = 0.0
    taken = itertools.chain([9.0, 9.0, 9.0], [0.004, 0.001, 0.003, 0.5, 0.002])
    shapes = []

    class Slow:
        name, device, precision, spec = "slow", "cpu", "fp32", ModelSpec(search_size=239)

        def template(self, crop: np.ndarray) -> Any:
            nonlocal clock
            clock += 100.0
            assert crop.shape == (127, 127, 3)
            return "kernels"

        def search(self, crop: np.ndarray, kernels: Any) -> Any:
            nonlocal clock
            clock += next(taken)
            shapes.append((crop.shape, crop.dtype, kernels))

        def search_many(self, crops: np.ndarray, kernels: list[Any]) -> Any:
            raise AssertionError("one target is timed")

    monkeypatch.setattr(time, "perf_counter", lambda: clock)
    assert search_milliseconds(Slow(), searches=5) == pytest.approx(3.0)
    assert shapes == [((239, 239, 3), np.uint8, "kernels")] * 8
