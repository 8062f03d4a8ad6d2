"""What a network costs: parameters and multiply-accumulates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from psiamfcpp.spec import ModelSpec

if TYPE_CHECKING:
    from torch import nn


def count_parameters(model: nn.Module) -> int:
    """Return the number of trainable values; running statistics are not among them."""
    return sum(p.numel() for p in model.parameters())


def search_macs(spec: ModelSpec) -> int:
    """Return the multiply-accumulates of one search crop: convolutions and correlations, from the spec alone."""
    return spec.arch.macs(spec.widths, spec.search_size)


def facts(spec: ModelSpec) -> dict[str, Any]:
    """Return ``parameters``, ``gmacs`` of a search crop, and ``widths`` of the network of a spec, from it alone."""
    parameters = spec.arch.parameters(spec.widths)
    return {"parameters": parameters, "gmacs": search_macs(spec) / 1e9, "widths": dict(spec.widths)}
