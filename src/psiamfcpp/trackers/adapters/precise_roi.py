"""Precise RoI pooling (Jiang et al., "Acquisition of Localization Confidence", ECCV 2018, section 3.3) in plain torch.

The published extension is compiled for CUDA alone. Here a bin is the exact integral of the bilinearly interpolated
features over it, divided by its area. The integral separates into columns and rows, so that pooling is two matrix
products, and its gradient in features and boxes is torch's.
"""

import sys
import types
from typing import Any


def _integral(t: Any) -> Any:
    """Return the integral from minus infinity to t of the hat function ``max(0, 1 - |t|)``."""
    t = t.clamp(-1, 1)
    return 0.5 + t - t * t.abs() / 2


def _weights(start: Any, end: Any, bins: int, size: int) -> Any:
    """Return ``(K, bins, size)``: the integral of each pixel's hat over each bin between ``start`` and ``end`` (K)."""
    import torch

    steps = torch.arange(bins + 1, dtype=start.dtype, device=start.device) / bins
    edges = start[:, None] + (end - start)[:, None] * steps
    pixels = torch.arange(size, dtype=start.dtype, device=start.device)
    below = _integral(edges[:, :, None] - pixels)
    return below[:, 1:] - below[:, :-1]


def prroi_pool2d(features: Any, rois: Any, pooled_height: int, pooled_width: int, spatial_scale: float) -> Any:
    """Return ``(K, C, pooled_height, pooled_width)``.

    Args:
        features: ``(B, C, H, W)``.
        rois: ``(K, 5)``: index in the batch, then x0, y0, x1, y1 in pixels of the image.
        pooled_height: rows of bins.
        pooled_width: columns of bins.
        spatial_scale: pixels of the features per pixel of the image.
    """
    import torch

    x0, y0, x1, y1 = (rois[:, 1:] * spatial_scale).unbind(1)
    columns = _weights(x0, x1, pooled_width, features.shape[3])
    rows = _weights(y0, y1, pooled_height, features.shape[2])
    area = (x1 - x0).clamp(min=0) * (y1 - y0).clamp(min=0) / (pooled_height * pooled_width)
    sums = torch.matmul(torch.matmul(rows[:, None], features[rois[:, 0].long()]), columns[:, None].transpose(2, 3))
    share = torch.where(area > 0, 1 / area.clamp(min=1e-12), torch.zeros_like(area))
    return sums * share[:, None, None, None]


def offer(package: str, device: str) -> None:
    """Offer this module under the name of the published one, where that cannot run.

    Args:
        package: name under which the tracker imports it.
        device: cpu or cuda.
    """
    import torch

    class PrRoIPool2D(torch.nn.Module):
        """Precise RoI pooling with fixed sizes."""

        def __init__(self, pooled_height: int, pooled_width: int, spatial_scale: float) -> None:
            super().__init__()
            self._sizes = (int(pooled_height), int(pooled_width), float(spatial_scale))

        def forward(self, features: Any, rois: Any) -> Any:
            return prroi_pool2d(features, rois, *self._sizes)

    if device == "cuda":
        try:
            __import__(package)
            return
        except ImportError:
            # the submodule is not there: slower, but the same numbers
            pass
    parts = package.split(".")
    for length in range(3, len(parts) + 1):
        name = ".".join(parts[:length])
        module = sys.modules[name] = types.ModuleType(name)
        module.__path__ = []
    module.PrRoIPool2D, module.prroi_pool2d = PrRoIPool2D, prroi_pool2d
