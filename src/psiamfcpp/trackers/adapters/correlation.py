"""Correlation of two feature maps (Dosovitskiy et al., "FlowNet", ICCV 2015, section 3) in plain torch.

It replaces the package spatial_correlation_sampler where that is not installed: it has to be compiled, and asks for
CUDA. As there, products are summed over channels and the kernel, and not divided by their number.
"""

import importlib.util
import sys
import types
from typing import Any


def correlate(first: Any, second: Any, kernel_size: int, patch_size: int) -> Any:
    """Return ``(B, patch_size, patch_size, H, W)``: by shift of the second map, rows first, for each place.

    Args:
        first: ``(B, C, H, W)``.
        second: ``(B, C, H, W)``.
        kernel_size: odd side of the square that products are summed over.
        patch_size: odd number of shifts in each direction.
    """
    import torch
    import torch.nn.functional as functional

    reach = patch_size // 2
    height, width = first.shape[2:]
    padded = functional.pad(second, [reach] * 4)
    rows = []
    for row in range(patch_size):
        shifts = [padded[:, :, row : row + height, column : column + width] for column in range(patch_size)]
        rows.append(torch.stack([(first * shifted).sum(1) for shifted in shifts], 1))
    products = torch.stack(rows, 1)
    flat = products.reshape(-1, 1, height, width)
    # the mean times the number is the sum; what lies outside counts as zero
    sums = functional.avg_pool2d(flat, kernel_size, 1, kernel_size // 2) * kernel_size**2
    return sums.reshape(products.shape)


def offer() -> None:
    """Offer this module as spatial_correlation_sampler, unless that is installed."""
    if importlib.util.find_spec("spatial_correlation_sampler") is not None:
        return
    import torch

    class SpatialCorrelationSampler(torch.nn.Module):
        """With stride 1 and the padding that keeps the size."""

        def __init__(self, kernel_size: int, patch_size: int, stride: int = 1, padding: int = 0) -> None:
            super().__init__()
            if stride != 1 or padding != kernel_size // 2:
                raise ValueError("only a stride of 1 and a padding of half the kernel are known")
            self._sizes = (kernel_size, patch_size)

        def forward(self, first: Any, second: Any) -> Any:
            return correlate(first, second, *self._sizes)

    module = sys.modules["spatial_correlation_sampler"] = types.ModuleType("spatial_correlation_sampler")
    module.SpatialCorrelationSampler = SpatialCorrelationSampler
