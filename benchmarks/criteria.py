"""Compare plans of pruning before any training, by agreement with the unpruned network on held-out pairs.

    python benchmarks/criteria.py MODEL --data clips:CLIPS --plans a.json b.json [--images 100] [--pairs 300]

Each plan is what `psiamfcpp plan` wrote. The model is cut by it and fitted (`psiamfcpp prune --data`), and looks at
pairs of clips that were held out of ranking and fitting. Prints for each: multiply-accumulates of a search crop; the
share of pairs in which it chooses the same cell as the unpruned network, by the published procedure; the mean overlap
of both boxes, and the share of pairs where that is above 0.7; and the mean overlap with the label.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
import tyro

from psiamfcpp.datasets.choice import HELD_OUT_EVERY, DataChoice
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import from_corners, overlap
from psiamfcpp.models import Network, load
from psiamfcpp.models.arch import opened
from psiamfcpp.models.cost import search_macs
from psiamfcpp.pruning import Plan, refit
from psiamfcpp.pruning.models import groups_of, prune_model
from psiamfcpp.recipes.fit_crops import batches, plain_pairs
from psiamfcpp.trackers.siamfcpp.procedure import Estimate, Target
from psiamfcpp.training.options import PairOptions
from psiamfcpp.training.pairs import Pair, PairSampler


def main(
    model: tyro.conf.Positional[str],
    data: tuple[str, ...],
    plans: tuple[Path, ...],
    images: int = 100,
    pairs: int = 300,
    held_out_every: int = HELD_OUT_EVERY,
    fit: bool = True,
) -> None:
    """Cut, fit, compare and print.

    Args:
        model: the unpruned model.
        data: sets to fit with and, of the part that is held out, to compare on, each LAYOUT:FOLDER.
        plans: files that `psiamfcpp plan` wrote; a model file is compared as it is.
        images: pairs of crops to fit with.
        pairs: held-out pairs to compare on.
        held_out_every: one clip in N is held out.
        fit: fit what is left of the network.
    """
    choice = DataChoice(data, held_out_every)
    network = load(model)
    options = PairOptions(search_size=network.spec.search_size, augmentation=0.0, negatives=0.0)
    sampler = PairSampler(choice.held_out, options, 1, 10**9, arch=network.spec.arch)
    drawn = [sampler.pair(i) for i in range(pairs)]
    wanted = [_look(network, pair) for pair in drawn]
    print(f"{'plan':24}   MMAC  same cell  overlap  above .7  with label")
    _print("unpruned", network, drawn, wanted, wanted)
    crops = list(batches(plain_pairs(choice.training, network.spec, 0), 0, images, 8)) if fit else []
    for path in plans:
        if path.suffix == ".safetensors":
            pruned = load(path)
        else:
            plan = Plan.read(path)
            pruned = prune_model(network, plan)
            pruned = refit(pruned, network, plan, crops, groups_of(network.spec)) if fit else pruned
        _print(path.stem, pruned, drawn, wanted, [_look(pruned, pair) for pair in drawn])


@torch.inference_mode()
def _look(network: Network, pair: Pair) -> Estimate:
    """Return what the procedure chooses for a pair. The target before is in the crop's middle, of the label's size."""
    spec = network.spec
    procedure = opened(spec.arch.procedure)
    z, x = (torch.from_numpy(image).permute(2, 0, 1)[None].float() for image in (pair.template, pair.search))
    scores, boxes = (out[0].numpy() for out in network(z, x))
    return procedure.estimate(scores, boxes, _before(pair), spec, procedure.window(scores.shape[0]))


def _before(pair: Pair) -> Target:
    x0, y0, x1, y1 = pair.corners
    return Target(0.0, 0.0, x1 - x0 + 1, y1 - y0 + 1)


def _print(name: str, network: Network, pairs: list[Pair], wanted: list[Estimate], found: list[Estimate]) -> None:
    same = np.mean([a.cell == b.cell for a, b in zip(wanted, found, strict=True)])
    theirs, ours = (np.array([_corners(estimate.target) for estimate in some]) for some in (wanted, found))
    labels = np.array([_label(network, pair) for pair in pairs])
    alike, right = (overlap(from_corners(ours), from_corners(other)) for other in (theirs, labels))
    row = f"{same:.3f}      {alike.mean():.3f}    {(alike > 0.7).mean():.3f}     {right.mean():.3f}"
    print(f"{name:24} {search_macs(network.spec) / 1e6:6.0f}  {row}", flush=True)


def _corners(target: Target) -> tuple[float, float, float, float]:
    w, h = (target.w - 1) / 2, (target.h - 1) / 2
    return target.cx - w, target.cy - h, target.cx + w, target.cy + h


def _label(network: Network, pair: Pair) -> tuple[float, float, float, float]:
    """Return the corners of the label in the coordinates of `_look`."""
    before, procedure = _before(pair), opened(network.spec.arch.procedure)
    zoom, middle = procedure.zoom(before, network.spec), procedure.middle(network.spec.search_size)
    x0, y0, x1, y1 = pair.corners
    cx, cy = ((low + high) / 2 - middle for low, high in ((x0, x1), (y0, y1)))
    return _corners(Target(cx / zoom, cy / zoom, before.w / zoom, before.h / zoom))


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except UserError as error:
        print(f"criteria.py: {error}", file=sys.stderr)
        sys.exit(2)
