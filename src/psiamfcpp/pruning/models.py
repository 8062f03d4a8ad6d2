"""Groups and pruning of this package's own networks, whose tables of layers say what is tied to what."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from psiamfcpp.models import Network, build
from psiamfcpp.pruning.groups import Group
from psiamfcpp.pruning.planning import Plan
from psiamfcpp.pruning.surgery import prune
from psiamfcpp.spec import ModelSpec


def groups_of(spec: ModelSpec) -> dict[str, Group]:
    """Return the groups of a network by name, from the table of its architecture and its widths."""
    arch = spec.arch
    return {
        name: Group(
            ties.maps,
            spec.widths[name],
            views=tuple(view for block in ties.maps for view in arch.views[block]),
            name=name,
            others=ties.others,
            readers=ties.readers,
        )
        for name, ties in ((name, arch.ties(name)) for name in arch.groups)
    }


def prune_model(model: Network, plan: Plan) -> Network:
    """Return a copy of a network with the filters that a plan keeps; its spec differs in the widths alone.

    Raises:
        UserError: as of `psiamfcpp.pruning.prune`.
    """
    device = next(model.parameters()).device
    example = tuple(crop.to(device) for crop in example_inputs(model.spec))
    cut = prune(model, example, plan, groups_of(model.spec))
    # Rebuilt from its widths, as loading will do, so that a network which does not fit them cannot come about.
    result = build(dataclasses.replace(model.spec, widths={**model.spec.widths, **plan.widths})).to(device)
    result.load_state_dict(cut.state_dict())
    return result.train(model.training)


def example_inputs(spec: ModelSpec) -> tuple[Tensor, Tensor]:
    """Return a random template and search crop ``(1, 3, S, S)``, 0..255, as a network's forward takes them."""
    generator = torch.Generator().manual_seed(0)
    template, search = (
        torch.rand(1, 3, size, size, generator=generator) * 255 for size in (spec.template_size, spec.search_size)
    )
    return template, search
