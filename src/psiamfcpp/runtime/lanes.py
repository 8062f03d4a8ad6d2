"""Several searches at once, each on its share of the threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np

from psiamfcpp.geometry import Image
from psiamfcpp.runtime.engine import Float32Array, Images

Search = Callable[[Image, Any], tuple[Float32Array, Float32Array]]


class Lanes:
    """`Engine.search_many` by single searches that run side by side.

    A search that has a thread to itself never waits for others, while one that is spread over threads does at each
    layer. A batch saves no more, since one crop keeps a core's arithmetic busy, and needs a graph for each size.

    Args:
        threads: that may be used in all.
        alone: a search on all of them.
        open_lanes: gives searches that may run at once, as many as asked for, on equal shares of the threads.
    """

    def __init__(self, threads: int, alone: Search, open_lanes: Callable[[int], Sequence[Search]]):
        self._threads, self._alone, self._lanes = threads, alone, cache(open_lanes)
        self._workers = ThreadPoolExecutor(threads, "search")

    def search_many(self, crops: Images, kernels: list[Any]) -> tuple[Float32Array, Float32Array]:
        """Scores ``(B, N, N)`` and boxes ``(B, N, N, 4)`` of crops ``(B, S, S, 3)``, each with kernels of its own."""
        answers: list[tuple[Float32Array, Float32Array]] = []
        while left := len(crops) - len(answers):
            # as many as divide the threads evenly, so that none is idle
            count = max(n for n in range(1, min(left, self._threads) + 1) if self._threads % n == 0)
            crop, own = crops[len(answers) :][:count], kernels[len(answers) :][:count]
            if count == 1:
                answers.append(self._alone(crop[0], own[0]))
            else:
                answers += self._workers.map(_search, self._lanes(count), crop, own)
        scores, boxes = (np.stack(part) for part in zip(*answers, strict=True))
        return scores, boxes


def _search(search: Search, crop: Image, kernels: Any) -> tuple[Float32Array, Float32Array]:
    return search(crop, kernels)
