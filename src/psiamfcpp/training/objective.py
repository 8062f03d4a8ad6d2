"""What the training loop needs of an architecture; `psiamfcpp.models.arch.Architecture.objective` names it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from psiamfcpp.models.network import Maps
from psiamfcpp.training.batches import Batch
from psiamfcpp.training.options import LossWeights


@dataclass(frozen=True)
class Objective:
    """Losses of a network's three maps."""

    labelled: Callable[[Maps, Batch, LossWeights], dict[str, Tensor]]
    """against the labels: ``cls``, ``centerness`` and ``iou``, as far as there are such, and ``total``"""
    taught: Callable[[Maps, Maps, Batch], Tensor]
    """against a teacher's maps of the same batch; 0 where they are equal"""
    stored: Callable[[Maps, Batch], Tensor] | None = None
    """against what a stored teacher says (`Batch.said`); None where such stores do not fit the network"""
