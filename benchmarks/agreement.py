"""Compare models of one architecture with the first of them, by their procedure, on crops of held-out clips.

    python benchmarks/agreement.py MODEL OTHER [OTHER ...] --data LAYOUT:FOLDER [LAYOUT:FOLDER ...]

Each pair of crops is of one target, in two frames at most 30 apart; the second crop is laid about a place up to 0.4
target sides off and a size up to 20 % off. All models take search crops of the first one's size. The clips are those
that training holds out. Printed are the share of pairs in which the same cell is chosen, the mean and the least overlap
of the chosen boxes, and the processor time of a search as a share of the first model's: the median of the ratios, pair
by pair, which other processes change little.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

import numpy as np
import tyro

from psiamfcpp.datasets.choice import HELD_OUT_EVERY, DataChoice
from psiamfcpp.errors import UserError
from psiamfcpp.export.crops import Pair, sample
from psiamfcpp.geometry import from_centre, overlap
from psiamfcpp.models.arch import opened
from psiamfcpp.runtime import Engine, open_engine
from psiamfcpp.trackers.siamfcpp.procedure import Estimate, Procedure, Target


def main(
    models: tyro.conf.Positional[tuple[str, ...]],
    data: tuple[str, ...],
    held_out_every: int = HELD_OUT_EVERY,
    pairs: int = 300,
    threads: int = 1,
) -> None:
    """Compare and print.

    Args:
        models: two or more; all are compared with the first.
        data: each LAYOUT:FOLDER, as for training.
        held_out_every: one clip in N is drawn from.
        pairs: number of targets.
        threads: threads of a model.
    """
    if len(models) < 2:
        raise UserError(f"{len(models)} models given: two or more, to compare, are expected")
    first = open_engine(models[0], threads=threads)
    spec = first.spec
    others = [open_engine(model, threads=threads, search_size=spec.search_size) for model in models[1:]]
    engines = [first, *others]
    crops = sample(DataChoice(data, held_out_every).held_out, spec, pairs)
    procedure: Procedure = opened(spec.arch.procedure)
    window = procedure.window(spec.arch.score_size(spec.search_size, spec.template_size))
    # Pair by pair, so that the models are timed in turn.
    rows = [[_found(engine, procedure, window, pair) for engine in engines] for pair in crops]
    (expected, own), *compared = (tuple(zip(*column, strict=True)) for column in zip(*rows, strict=True))
    for model, (found, times) in zip(models[1:], compared, strict=True):
        same = np.mean([a.cell == b.cell for a, b in zip(expected, found, strict=True)])
        each, share = overlap(_boxes(expected), _boxes(found)), np.median(np.divide(times, own))
        print(f"{model}: same cell {same:.3f}, overlap {each.mean():.3f}, least {each.min():.3f}, time {share:.2f}")


def _found(engine: Engine, procedure: Procedure, window: np.ndarray, pair: Pair) -> tuple[Estimate, float]:
    """Return the choice for a target in the middle of the crop, and the processor time of the search in seconds."""
    side = float(engine.spec.search_size)
    kernels = engine.template(pair.template)
    start = time.process_time()
    scores, boxes = engine.search(pair.search, kernels)
    spent = time.process_time() - start
    target = Target(side / 2, side / 2, side / 4, side / 4)
    return procedure.estimate(scores, boxes, target, engine.spec, window), spent


def _boxes(found: Sequence[Estimate]) -> np.ndarray:
    return np.array([from_centre(t.cx, t.cy, t.w, t.h) for t in (estimate.target for estimate in found)])


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except UserError as error:
        print(f"agreement.py: {error}", file=sys.stderr)
        sys.exit(2)
