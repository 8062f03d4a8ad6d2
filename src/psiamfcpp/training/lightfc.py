"""What LightFC is trained to: a peak at the target's cell and the box there, or another LightFC's maps.

Of labels, the score map learns a Gaussian about the target's cell by the focal loss of CenterNet (Zhou et al. 2019,
equation 1), and the boxes of the cells under the Gaussian learn the labelled box by -log overlap.
"""

from __future__ import annotations

import torch
from torch import Tensor

from psiamfcpp.models.lightfc import to_boxes
from psiamfcpp.models.network import Maps
from psiamfcpp.training.batches import Batch
from psiamfcpp.training.objective import Objective
from psiamfcpp.training.options import LossWeights

# Standard deviation of the Gaussian as a share of the target's side; a third of a cell at least.
_SPREAD = 0.1


def peaks(corners: Tensor, present: Tensor, search_size: int, cells: int) -> Tensor:
    """Return the score map ``(B, N, N)`` that labels ask for: 1 at the target's cell, and a Gaussian about it.

    Args:
        corners: ``(B, 4)`` as x0, y0, x1, y1 in pixels of the search crop.
        present: ``(B,)`` bool: False for a negative pair, whose map is 0.
        search_size: side of the search crop in pixels.
        cells: side N of the score map.
    """
    # From edge to edge, in cells.
    low, high = corners[:, :2] * cells / search_size, (corners[:, 2:] + 1) * cells / search_size
    cell = ((low + high) / 2).floor()
    spread = ((high - low) * _SPREAD).clamp(min=1 / 3)
    line = torch.arange(cells, device=corners.device)
    x, y = (torch.exp(-((line - cell[:, i : i + 1]) ** 2) / (2 * spread[:, i : i + 1] ** 2)) for i in (0, 1))
    inside = ((cell >= 0) & (cell < cells)).all(dim=1) & present
    return y[:, :, None] * x[:, None, :] * inside[:, None, None]


def labelled(maps: Maps, batch: Batch, weights: LossWeights) -> dict[str, Tensor]:
    """The losses of a batch against its labels; maps as of `psiamfcpp.models.lightfc.LightFC.maps`."""
    score, size, offset = maps
    score, side = score.squeeze(1), batch.search.shape[1]
    peak = peaks(batch.corners, batch.present, side, score.shape[1])
    middle = peak == 1
    focal = torch.where(middle, (1 - score) ** 2 * score.log(), (1 - peak) ** 4 * score**2 * (1 - score).log())
    boxes = to_boxes(size, offset)
    apart = -torch.log(overlap(boxes, batch.corners[:, None, None]).clamp(min=1e-6))
    parts = {
        "cls": -focal.sum() / middle.sum().clamp(min=1),
        "iou": (apart * peak).sum() / peak.sum().clamp(min=1e-6),
    }
    parts["total"] = weights.cls_weight * parts["cls"] + weights.iou_weight * parts["iou"]
    return parts


def taught(maps: Maps, wanted: Maps, batch: Batch) -> Tensor:
    """How far a network's maps are from its teacher's; 0 where they are equal. Labels play no part.

    Scores: Kullback-Leibler divergence of each cell's probability, the mean weighted by the teacher's score plus that
    weighted by what is left to 1, since background cells outnumber those of the target. Boxes: -log overlap, weighted
    by the teacher's score.
    """
    score, trust = maps[0].squeeze(1), wanted[0].squeeze(1)
    apart = trust * (trust / score).log() + (1 - trust) * ((1 - trust) / (1 - score)).log()
    boxes = -torch.log(overlap(to_boxes(*maps[1:]), to_boxes(*wanted[1:])).clamp(min=1e-6))
    return _mean(apart, trust) + _mean(apart, 1 - trust) + _mean(boxes, trust)


def overlap(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union ``(...)`` of boxes ``(..., 4)`` as x0, y0, x1, y1, last column and row included."""
    sides = (torch.minimum(a[..., 2:], b[..., 2:]) - torch.maximum(a[..., :2], b[..., :2]) + 1).clamp(min=0)
    inter = sides.prod(dim=-1)
    areas = ((box[..., 2:] - box[..., :2] + 1).prod(dim=-1) for box in (a, b))
    return inter / (sum(areas) - inter)


def _mean(values: Tensor, weights: Tensor) -> Tensor:
    return (values * weights).sum() / weights.sum().clamp(min=1e-6)


OBJECTIVE = Objective(labelled, taught)
