"""How long an engine takes, for those who choose a network by its time."""

from __future__ import annotations

import statistics
import time

import numpy as np

from psiamfcpp.runtime.engine import Engine


def search_milliseconds(engine: Engine, searches: int = 12) -> float:
    """Return the median time of `Engine.search` on crops of noise, after three searches that do not count.

    Only the engine is timed: a whole update also crops the frame and decodes the score map.

    Args:
        engine: the loaded model; copies to and from a GPU are part of the time.
        searches: how many are timed.
    """
    rng = np.random.default_rng(0)
    z, x = (
        rng.integers(0, 256, (side, side, 3), np.uint8) for side in (engine.spec.template_size, engine.spec.search_size)
    )
    kernels = engine.template(z)
    taken = []
    for _ in range(3 + searches):
        start = time.perf_counter()
        engine.search(x, kernels)
        taken.append(1e3 * (time.perf_counter() - start))
    return statistics.median(taken[3:])
