"""Channels brought to one range before they are rounded, where this costs nothing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from psiamfcpp.export.layers import Float32Array
from psiamfcpp.models.arch import Architecture

# A channel whose range is smaller than this share of the largest is treated as if it had this one: on other crops it
# may hold more than was measured.
_SMALLEST = 1 / 16


def factors(arch: Architecture, peaks: Mapping[str, Float32Array]) -> dict[str, Float32Array]:
    """Return what to divide the channels of maps by that depthwise convolutions alone read.

    Each channel has filters of its own on both sides, and each filter a step of its own, so any factor may move from
    the one to the other (Nagel et al. 2019, section 4.1). The factors bring all channels to one range. ReLU6 keeps
    them up to that range, the highest value of the channel's that was measured.

    Args:
        arch: the table.
        peaks: by row, the largest magnitude ``(C,)`` of each channel of its map.

    Returns:
        Factors ``(C,)``, at most 1, by row.
    """
    found = {}
    for row in arch.layers:
        readers = [other.operation for other in arch.layers if row.name in other.reads]
        if row.operation == "convolution" and row.activation in (None, "relu6") and set(readers) == {"depthwise"}:
            own = peaks[row.name]
            found[row.name] = np.maximum(own / max(own.max(), 1e-6), _SMALLEST).astype(np.float32)
    return found
