"""Learning from another network's maps and features, for a pruned one normally the network that it was cut from."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from psiamfcpp.errors import UserError
from psiamfcpp.models import load
from psiamfcpp.models.arch import DEFAULT
from psiamfcpp.models.network import Maps, Network
from psiamfcpp.training.batches import Batch
from psiamfcpp.training.losses import iou


class Answer(NamedTuple):
    """What a network makes of a batch."""

    template: Tensor
    """the backbone's features of the template crops"""
    search: Tensor
    """and of the search crops"""
    maps: Maps
    """as of the network's ``maps``: for SiamFC++ class and centre-ness logits and distances"""


Teacher = Callable[[Batch], Answer]


def answer(model: Network, batch: Batch) -> Answer:
    """One pass of a batch."""
    template, search = model.features(batch.template_input()), model.features(batch.search_input())
    return Answer(template, search, model.maps(search, model.kernels(template)))


def open_teacher(path_or_name: str, device: torch.device, architecture: str = DEFAULT) -> Teacher:
    """A function from a batch to what a model of an architecture makes of it.

    Raises:
        UserError: no such model, or it is of another architecture.
    """
    model = load(path_or_name)
    if model.spec.architecture != architecture:
        raise UserError(
            f"teacher {path_or_name} is of architecture {model.spec.architecture}, whose maps differ from those of "
            f"{architecture}: give a {architecture}"
        )
    model.to(device).requires_grad_(False)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @torch.no_grad()
    def teacher(batch: Batch) -> Answer:
        return answer(model, batch)

    return teacher


def teacher_loss(maps: Maps, wanted: Maps, positive: Tensor) -> Tensor:
    """How far a network's maps are from its teacher's; 0 where they are equal.

    Class and centre-ness: Kullback-Leibler divergence of each cell's probability, the mean over positive cells plus
    that over background cells, which outnumber them. Boxes: -log overlap, weighted by the teacher's score of the cell.

    Args:
        maps: class and centre-ness logits ``(B, N, N)`` and distances ``(B, N, N, 4)``, as of `SiamFCpp.maps`.
        wanted: the teacher's.
        positive: ``(B, N, N)`` bool: cells inside the labelled box.
    """
    total = maps[0].new_zeros(())
    for logits, taught in zip(maps[:2], wanted[:2], strict=True):
        apart = _divergence(logits, taught)
        for cells in (positive, ~positive):
            total = total + (apart * cells).sum() / cells.sum().clamp(min=1)
    trust = torch.sigmoid(wanted[0]) * torch.sigmoid(wanted[1])
    boxes = -torch.log(iou(maps[2], wanted[2]).clamp(min=1e-6))
    return total + (boxes * trust).sum() / trust.sum().clamp(min=1e-6)


def _divergence(logits: Tensor, taught: Tensor) -> Tensor:
    """Kullback-Leibler divergence of the probabilities that logits stand for, cell by cell."""
    chance = torch.sigmoid(taught)
    cross = F.binary_cross_entropy_with_logits(logits, chance, reduction="none")
    return cross - F.binary_cross_entropy_with_logits(taught, chance, reduction="none")


def feature_loss(found: Answer, wanted: Answer) -> Tensor:
    """How far a network's features are from its teacher's: squared distance over variance, the mean of both crops.

    It is 0 where they are equal and 1 where a network gives each channel's mean alone. (Romero et al. 2015, FitNets,
    without the layer between: the paper's plan leaves the backbone's last layer whole.)

    Raises:
        UserError: the two have features of different widths.
    """
    widths = found.search.shape[1], wanted.search.shape[1]
    if widths[0] != widths[1]:
        raise UserError(f"teacher-features needs equally many features: {widths[0]} here, {widths[1]} of the teacher")
    shares = []
    for mine, taught in ((found.template, wanted.template), (found.search, wanted.search)):
        taught = taught.float()
        spread = (taught - taught.mean(dim=(0, 2, 3), keepdim=True)).square().mean()
        shares.append((mine.float() - taught).square().mean() / spread.clamp(min=1e-12))
    return (shares[0] + shares[1]) / 2
