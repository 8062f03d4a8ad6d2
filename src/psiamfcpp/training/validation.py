"""The pair score: how often, and how well, the network finds held-out targets in single search crops."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from psiamfcpp.datasets import Sequence
from psiamfcpp.datasets.frames import FrameStore
from psiamfcpp.geometry import from_corners, overlap
from psiamfcpp.models.arch import DEFAULT, Architecture, architecture
from psiamfcpp.models.network import Network
from psiamfcpp.training.batches import Batch, collate
from psiamfcpp.training.options import PairOptions
from psiamfcpp.training.pairs import PairSampler


@dataclass(frozen=True)
class PairScore:
    """Means over held-out pairs; the box is that of the cell with the highest score, without window or penalty."""

    within8: float
    """share of pairs with a centre error of at most 8 pixels of the crop"""
    within16: float
    """share of pairs with a centre error of at most 16 pixels of the crop"""
    overlap: float
    """mean overlap with the labelled box"""
    score: float
    """mean highest score where the target is there"""
    separation: float | None
    """share of couples of a true and a negative pair in which the true one scores higher; None without negative ones"""


def held_out_batches(
    sequences: list[Sequence],
    options: PairOptions,
    count: int,
    batch: int,
    store: FrameStore | None = None,
    arch: Architecture = architecture(DEFAULT),  # noqa: B008 - frozen
) -> list[Batch]:
    """``count`` fixed pairs without augmentation, a fifth of them negative ones; `PairSampler` has the store."""
    plain = dataclasses.replace(options, augmentation=0.0, negatives=0.2)
    sampler = PairSampler(sequences, plain, seed=1, store=store, arch=arch)
    return [collate([sampler.pair(i) for i in range(k, min(k + batch, count))]) for k in range(0, count, batch)]


@torch.no_grad()
def pair_score(model: Network, batches: Iterable[Batch], bf16: bool = False) -> PairScore:
    """The pair score of a network, put into evaluation mode for it and back."""
    # Mode by mode: while training, the backbone is in evaluation mode and the rest is not.
    modes = {module: module.training for module in model.modules()}
    model.eval()
    device = next(model.parameters()).device
    errors, overlaps, true_scores, false_scores = [], [], [], []
    for batch in batches:
        with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
            moved = batch.to(device)
            scores, boxes = model.search(moved.search_input(), model.template(moved.template_input()))
        scores, boxes = scores.cpu(), boxes.cpu()
        best = scores.flatten(1).argmax(dim=1)
        rows = torch.arange(len(best))
        found, top = boxes.flatten(1, 2)[rows, best], scores.flatten(1)[rows, best]
        middle = (found[:, :2] + found[:, 2:] - batch.corners[:, :2] - batch.corners[:, 2:]) / 2
        true = batch.present & _reachable(batch.corners, batch.search.shape[1])
        errors.append(middle.norm(dim=1)[true])
        overlaps.append(_overlap(found[true], batch.corners[true]))
        true_scores.append(top[true])
        false_scores.append(top[~true])
    for module, training in modes.items():
        module.training = training
    error, overlaps_ = torch.cat(errors).numpy(), torch.cat(overlaps).numpy()
    high, low = torch.cat(true_scores).numpy(), torch.cat(false_scores).numpy()
    return PairScore(
        within8=float(np.mean(error <= 8)),
        within16=float(np.mean(error <= 16)),
        overlap=float(overlaps_.mean()),
        score=float(high.mean()),
        separation=float((high[:, None] > low[None]).mean()) if len(low) else None,
    )


def _reachable(corners: Tensor, search_size: int) -> Tensor:
    middle = (corners[:, :2] + corners[:, 2:]) / 2
    return ((middle >= 0) & (middle <= search_size - 1)).all(dim=1)


def _overlap(a: Tensor, b: Tensor) -> Tensor:
    return torch.from_numpy(overlap(from_corners(a.numpy()), from_corners(b.numpy())))
