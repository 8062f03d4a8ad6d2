"""LightFC as plain modules, made from its table; BatchNorm is folded into its convolutions, as it is deployed."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from psiamfcpp.models.arch import PIXELS, Layer, by_depth, walk
from psiamfcpp.models.lightfc_table import ARCHITECTURE
from psiamfcpp.models.network import Network, Part
from psiamfcpp.spec import ModelSpec

Kernels = tuple[Tensor]

# ImageNet's, in the order BGR and for pixels of 0..255.
MEAN = (255 * 0.406, 255 * 0.456, 255 * 0.485)
STD = (255 * 0.225, 255 * 0.224, 255 * 0.229)
# Scores and sizes are kept this far from 0 and 1 (CenterNet, Zhou et al. 2019).
MARGIN = 1e-4

_OPERATIONS: Mapping[str, Callable[..., Tensor]] = {
    "cells": lambda features, kernels: correlate_cells(features, kernels),
    "sum": torch.add,
    "join": lambda *maps: torch.cat(maps, dim=1),
    "mean": lambda x: x.mean(dim=(2, 3), keepdim=True),
    "gate": torch.mul,
}


class LightFC(Network):
    """LightFC (Li et al. 2024)."""

    def __init__(self, spec: ModelSpec):
        super().__init__(spec)
        self.backbone, self.fusion, self.head = (Part(name, spec) for name in ("backbone", "fusion", "head"))
        self._features = [row for row in spec.arch.layers if row.part == "backbone"]
        self._others = by_depth(row for row in spec.arch.layers if row.part != "backbone" and not _crosses(row))
        (self._correlation,) = (row for row in spec.arch.layers if _crosses(row))
        self.register_buffer("_mean", torch.tensor(MEAN).reshape(1, 3, 1, 1), persistent=False)

    def template(self, z: Tensor) -> Kernels:
        """Features of template crops, whose cells are correlated with.

        Args:
            z: ``(B, 3, 128, 128)``, BGR, float 0..255.

        Returns:
            One tensor ``(B, 96, 8, 8)``.
        """
        return self.kernels(self.features(z))

    def kernels(self, features: Tensor) -> Kernels:
        """`template`, from the backbone's features on."""
        return (features,)

    def features(self, x: Tensor) -> Tensor:
        """Features ``(B, 96, S / 16, S / 16)`` of crops ``(B, 3, S, S)``, BGR, float 0..255.

        The mean is subtracted before the first layer, whose weights hold channel order and deviation: its padding
        is the mean colour, which no bias can stand for at the border.
        """
        return walk(self._features, {PIXELS: x - self.get_buffer("_mean")}, self._run)[self._features[-1].name]

    def search(self, x: Tensor, kernels: Kernels) -> tuple[Tensor, Tensor]:
        """Scores and boxes of search crops.

        Args:
            x: ``(B, 3, S, S)``, BGR, float 0..255; S of 256 gives N = 16.
            kernels: what `template` returned, for a batch of B or of 1.

        Returns:
            scores ``(B, N, N)``, 0..1; boxes ``(B, N, N, 4)`` as x0, y0, x1, y1 in pixels of the crop, last column
            and row included.
        """
        score, size, offset = self.maps(self.features(x), kernels)
        return score.squeeze(1), to_boxes(size, offset)

    def maps(self, features: Tensor, kernels: Kernels) -> tuple[Tensor, Tensor, Tensor]:
        """What the three heads say, from the backbone's features on.

        Returns:
            Scores ``(B, 1, N, N)``, sizes ``(B, 2, N, N)`` as shares of a crop of 256 pixels, width first, and offsets
            ``(B, 2, N, N)`` of the centre from the cell's corner in cells, x first.
        """
        known = {self._features[-1].name: features, self._correlation.name: correlate_cells(features, kernels[0])}
        found = walk(self._others, known, self._run)
        score, size = (found[f"head.{name}"].float().clamp(MARGIN, 1 - MARGIN) for name in ("score", "size"))
        return score, size, found["head.offset"].float()

    def _run(self, row: Layer, *read: Tensor) -> Tensor:
        """Return the map that one layer makes of the maps that it reads."""
        if row.operation in _OPERATIONS:
            return _OPERATIONS[row.operation](*read)
        out: Tensor = self.get_submodule(row.name)(*read)
        return out


def correlate_cells(features: Tensor, kernels: Tensor) -> Tensor:
    """Multiply each cell of ``(B, C, H, W)`` with each of ``(B or 1, C, h, w)``: ``(B, h * w, H, W)``.

    The pixel-wise correlation of Alpha-Refine (Yan et al. 2021); channel ``i`` belongs to cell ``i``, row by row.
    """
    out = kernels.flatten(2).transpose(1, 2) @ features.flatten(2)
    return out.unflatten(2, features.shape[-2:])


def to_boxes(size: Tensor, offset: Tensor) -> Tensor:
    """Corners ``(B, N, N, 4)`` in pixels of the crop from the maps of `LightFC.maps`.

    Sizes are shares of the crop that LightFC was trained with. A crop of another side shows a target at the same scale,
    so that the same share means the same pixels.
    """
    line = torch.arange(size.shape[-1], device=size.device, dtype=torch.float32)
    y, x = torch.meshgrid(line, line, indexing="ij")
    # Centres count from the edge of the first pixel, corners are indices of pixels.
    centres = (torch.stack([x, y]) + offset) * ARCHITECTURE.stride
    half = size * (ARCHITECTURE.search_size / 2)
    return torch.cat([centres - half, centres + half - 1], dim=1).permute(0, 2, 3, 1)


def _crosses(row: Layer) -> bool:
    return row.operation == "cells"
