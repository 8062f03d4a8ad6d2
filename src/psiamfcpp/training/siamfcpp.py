"""What SiamFC++ is trained to: its three losses, a teacher's maps, a stored teacher's places and boxes."""

from __future__ import annotations

from torch import Tensor

from psiamfcpp.models.network import Maps
from psiamfcpp.training.batches import Batch
from psiamfcpp.training.losses import losses
from psiamfcpp.training.objective import Objective
from psiamfcpp.training.options import LossWeights
from psiamfcpp.training.stored import on_cells, stored_loss
from psiamfcpp.training.targets import Targets, assign
from psiamfcpp.training.teacher import teacher_loss


def _targets(maps: Maps, batch: Batch) -> Targets:
    return assign(batch.corners, batch.present, batch.search.shape[1], maps[0].shape[1])


def _labelled(maps: Maps, batch: Batch, weights: LossWeights) -> dict[str, Tensor]:
    return losses(maps, _targets(maps, batch), weights)


def _taught(maps: Maps, wanted: Maps, batch: Batch) -> Tensor:
    return teacher_loss(maps, wanted, _targets(maps, batch).positive)


def _stored(maps: Maps, batch: Batch) -> Tensor:
    assert batch.said is not None
    scores, sides, corners, trust = batch.said
    size = batch.search.shape[1]
    seen = on_cells(scores, sides, size, maps[0].shape[1])
    return stored_loss(maps, seen, corners, trust, _targets(maps, batch).positive, size)


OBJECTIVE = Objective(_labelled, _taught, _stored)
