"""The three losses of SiamFC++ (paper, equation 2): focal, centre-ness and IoU."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from psiamfcpp.training.options import LossWeights
from psiamfcpp.training.targets import Targets


def focal_loss(logits: Tensor, positive: Tensor, alpha: float, gamma: float = 2.0) -> Tensor:
    """Sum over cells of the focal loss (Lin et al. 2017, equation 5) of logits ``(...)`` against bool labels."""
    labels = positive.float()
    cross_entropy = F.binary_cross_entropy_with_logits(logits, labels, reduction="none")
    wrong = (torch.sigmoid(logits) - labels).abs()
    weight = torch.where(positive, alpha, 1 - alpha)
    return (weight * wrong**gamma * cross_entropy).sum()


def iou(predicted: Tensor, wanted: Tensor) -> Tensor:
    """Overlap ``(...)`` of boxes given as distances l, t, r, b ``(..., 4)`` from the same point."""
    inter = torch.minimum(predicted, wanted)
    area = (inter[..., 0] + inter[..., 2]) * (inter[..., 1] + inter[..., 3])
    union = sum((d[..., 0] + d[..., 2]) * (d[..., 1] + d[..., 3]) for d in (predicted, wanted)) - area
    return area / union


def losses(maps: tuple[Tensor, Tensor, Tensor], targets: Targets, weights: LossWeights) -> dict[str, Tensor]:
    """The losses of a batch, each divided by the number of positive cells, and their weighted sum ``total``.

    Centre-ness and overlap count on positive cells only; the overlap is weighted by the wanted centre-ness (FCOS),
    since the cells that decide a box while tracking lie near the centre.

    Args:
        maps: class and centre-ness logits ``(B, N, N)`` and distances ``(B, N, N, 4)``, as of `SiamFCpp.maps`.
        targets: the labels.
        weights: weights in the sum.
    """
    cls, centerness, distances = maps
    positive, count = targets.positive, targets.positive.sum().clamp(min=1)
    # Masked sums, not masked selection: a GPU would have to report how many cells there are before it goes on.
    quality = targets.centerness
    overlap_loss = -torch.log(iou(distances, targets.distances).clamp(min=1e-6))
    centre_loss = F.binary_cross_entropy_with_logits(centerness, quality, reduction="none")
    parts = {
        "cls": focal_loss(cls, positive, weights.focal_alpha) / count,
        "centerness": (centre_loss * positive).sum() / count,
        "iou": (overlap_loss * quality).sum() / quality.sum().clamp(min=1e-6),
    }
    parts["total"] = (
        weights.cls_weight * parts["cls"]
        + weights.centerness_weight * parts["centerness"]
        + weights.iou_weight * parts["iou"]
    )
    return parts
