"""Networks to prune, and tables to plan with."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from torch import nn

from psiamfcpp.models import SiamFCpp
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.pruning import Plan, RankTable
from psiamfcpp.pruning.groups import Group
from psiamfcpp.pruning.table import GroupRanks
from psiamfcpp.spec import ModelSpec

WIDTHS = {name: 4 + 2 * (number % 3) for number, name in enumerate(ARCHITECTURE.groups)}


def randomize(model: nn.Module, seed: int = 0) -> nn.Module:
    """Weights of a steady signal, and BatchNorm with a scale, a shift and statistics of its own."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, value in model.state_dict().items():
            if value.ndim == 4:
                value.normal_(0, (2 / value[0].numel()) ** 0.5, generator=generator)
            elif name.endswith("running_var"):
                value.uniform_(0.5, 1.5, generator=generator)
            elif value.is_floating_point():
                value.normal_(0.2, 0.3, generator=generator)
    return model.eval()


@pytest.fixture(scope="session")
def example() -> ModuleType:
    """The example of the documentation as a module."""
    path = Path(__file__).parents[2] / "examples" / "prune_any_network.py"
    spec = importlib.util.spec_from_file_location("prune_any_network", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def residual(example: ModuleType) -> nn.Module:
    """The example's residual network with grouped convolutions."""
    return randomize(example.Net())


@pytest.fixture
def siamese() -> SiamFCpp:
    """A narrow network of ours with uneven widths."""
    network = SiamFCpp(ModelSpec(widths=dict(WIDTHS), search_size=191))
    randomize(network)
    with torch.no_grad():
        network.backbone.conv1.conv.weight /= 100
    return network


@pytest.fixture
def pair() -> tuple[torch.Tensor, torch.Tensor]:
    """Template and search crops of two pairs."""
    generator = torch.Generator().manual_seed(5)
    return tuple(torch.rand(2, 3, size, size, generator=generator) * 255 for size in (127, 191))  # type: ignore[return-value]


@pytest.fixture
def make_table() -> Callable[..., RankTable]:
    """A table of the 13 groups: ranks rising from 0.5 to the width, in a shuffled order, necks and conv5 flat."""

    def make(widths: dict[str, int] = ARCHITECTURE.groups, norms: bool = True) -> RankTable:
        rng = np.random.default_rng(0)
        groups = {}
        for name, width in widths.items():
            flat = name in ("backbone.conv5", "neck.cls", "neck.reg")
            ranks = 20 + 0.01 * rng.random(width) if flat else rng.permutation(width) + 0.5
            groups[name] = GroupRanks(ranks, float(max(ranks)), rng.random(width) if norms else None)
        return RankTable(100, groups)

    return make


def silence(model: nn.Module, plan: Plan, groups: dict[str, Group]) -> None:
    """Make the maps of the filters that a plan removes zero, after the whole block."""
    for name, filters in plan.keep.items():
        keep = torch.zeros(groups[name].width)
        keep[filters] = 1
        for block in groups[name].blocks:
            model.get_submodule(block).register_forward_hook(
                lambda _module, _args, output, keep=keep: output * keep[:, None, None]
            )
