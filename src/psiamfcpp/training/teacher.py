"""Learning from another network's maps, for a pruned one normally the network that it was cut from."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from psiamfcpp.models import load
from psiamfcpp.training.batches import Batch
from psiamfcpp.training.losses import iou

Maps = tuple[Tensor, Tensor, Tensor]
Teacher = Callable[[Batch], Maps]


def open_teacher(path_or_name: str, device: torch.device) -> Teacher:
    """A function from a batch to the maps, as of `SiamFCpp.maps`, that a model gives for it.

    Raises:
        UserError: no such model.
    """
    model = load(path_or_name).to(device).requires_grad_(False)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @torch.no_grad()
    def maps(batch: Batch) -> Maps:
        return model.maps(batch.search_input(), model.template(batch.template_input()))

    return maps


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
