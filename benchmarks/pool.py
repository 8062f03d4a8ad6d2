"""Time several targets: one call of the engine per frame against a search for each.

    python benchmarks/pool.py --targets 4 --threads 2

Prints the time of a frame with one target, with N in a `TargetPool`, and with N trackers one after the other, the
median over frames of the demo clip; the three take turns, so that a disturbance of the machine meets all.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from itertools import islice

import numpy as np
import tyro

from psiamfcpp import TargetPool, Tracker, TrackerOptions
from psiamfcpp.demo.clip import render
from psiamfcpp.zoo import DEFAULT_MODEL


def main(
    targets: int = 4,
    frames: int = 60,
    model: str = DEFAULT_MODEL,
    engine: str | None = None,
    threads: int | None = None,
    search_size: int | None = None,
) -> None:
    """Measure and print one JSON object.

    Args:
        targets: how many are followed at once.
        frames: of the demo clip.
        model: name of a shipped model, or a model file.
        engine: what runs the network.
        threads: threads of the engine; by default all cores.
        search_size: side of the search crop in pixels.
    """
    shots = list(islice(render(0), frames))
    first, box = shots[0].image, shots[0].box
    options = TrackerOptions(engine, threads=threads, search_size=search_size)
    one, pool = TargetPool(model, options=options), TargetPool(model, options=options)
    one.add(first, box)
    # the same box: what is measured does not depend on what is seen
    for _ in range(targets):
        pool.add(first, box)
    tracker = Tracker(model, options=options)
    alone = [tracker.follow(first, box) for _ in range(targets)]
    ways: dict[str, Callable[[np.ndarray], object]] = {
        "one": one.update,
        "pool": pool.update,
        "one_by_one": lambda image: [target.update(image, tracker.engine.search) for target in alone],
    }
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for shot in shots[1:]:
        for name, update in ways.items():
            start = time.perf_counter()
            update(shot.image)
            taken[name].append(1000 * (time.perf_counter() - start))
    medians = {f"{name}_ms": round(float(np.median(values)), 2) for name, values in taken.items()}
    share = round(medians["pool_ms"] / medians["one_by_one_ms"], 3)
    print(json.dumps({"model": model, "targets": targets, "frames": frames - 1, **medians, "pool_share": share}))


if __name__ == "__main__":
    tyro.cli(main)
