"""What the network should say at each cell of the score map (SiamFC++, section 3; FCOS, section 3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from psiamfcpp.models.network import cell_grid


@dataclass(frozen=True)
class Targets:
    """Labels of a batch: for B pairs and N x N cells."""

    positive: Tensor
    """``(B, N, N)`` bool: cells inside the box"""
    centerness: Tensor
    """``(B, N, N)``, 0..1, 0 where not positive"""
    distances: Tensor
    """``(B, N, N, 4)``: l, t, r, b from the cell to the box's sides, pixels; meaningful where positive"""


def assign(boxes: Tensor, present: Tensor, search_size: int, cells: int) -> Targets:
    """Assign labels to cells.

    A cell inside the box is positive. A box so small or so far off that it holds no cell still gets its nearest one
    if that lies within a stride, with distances kept above half a pixel.

    Args:
        boxes: ``(B, 4)`` as x0, y0, x1, y1 in pixels of the search crop.
        present: ``(B,)`` bool: False for a negative pair, which has no positive cell.
        search_size: side of the search crop in pixels.
        cells: side N of the score map.

    Returns:
        The labels.
    """
    grid = cell_grid(search_size, cells, boxes.device)
    low, high = boxes[:, None, None, :2], boxes[:, None, None, 2:]
    distances = torch.cat([grid - low, high - grid], dim=-1)
    positive = (distances > 0).all(dim=-1)
    offset = (grid - (low + high) / 2).abs().amax(dim=-1)
    nearest = (offset == offset.amin(dim=(1, 2), keepdim=True)) & (offset < 8)
    positive = positive | (nearest & ~positive.any(dim=(1, 2), keepdim=True))
    positive = positive & present[:, None, None]
    distances = distances.clamp(min=0.5)
    left, top, right, bottom = distances.unbind(dim=-1)
    ratio = torch.minimum(left, right) / torch.maximum(left, right)
    ratio = ratio * torch.minimum(top, bottom) / torch.maximum(top, bottom)
    return Targets(positive, ratio.sqrt() * positive, distances)
