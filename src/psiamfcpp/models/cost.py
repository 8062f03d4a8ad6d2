"""Parameters and multiply-accumulates of a network."""

from __future__ import annotations

from collections.abc import Mapping

from torch import nn

from psiamfcpp.spec import TEMPLATE_SIZE, feature_size


def count_parameters(model: nn.Module) -> int:
    """Number of trainable values; running statistics are not among them."""
    return sum(p.numel() for p in model.parameters())


def search_macs(widths: Mapping[str, int], search_size: int) -> int:
    """Multiply-accumulates of one search crop: convolutions and correlations, from widths alone."""
    w = [widths[f"backbone.conv{i}"] for i in range(1, 6)]
    conv1 = (search_size - 11) // 2 + 1
    conv2 = -(-(conv1 - 3) // 2) + 1 - 4
    last = feature_size(search_size)
    macs = 3 * w[0] * 11**2 * conv1**2 + w[0] * w[1] * 5**2 * conv2**2
    macs += 9 * (w[1] * w[2] * (last + 4) ** 2 + w[2] * w[3] * (last + 2) ** 2 + w[3] * w[4] * last**2)
    kernel = feature_size(TEMPLATE_SIZE) - 2
    correlation = last - 2 - kernel + 1
    for branch, outputs in (("cls", 2), ("reg", 4)):
        neck = widths[f"neck.{branch}"]
        macs += 9 * w[4] * neck * (last - 2) ** 2 + neck * kernel**2 * correlation**2
        chain = [neck, *(widths[f"head.{branch}{i}"] for i in (1, 2, 3))]
        for i in range(3):
            macs += 9 * chain[i] * chain[i + 1] * (correlation - 2 * (i + 1)) ** 2
        macs += chain[3] * outputs * (correlation - 6) ** 2
    return macs
