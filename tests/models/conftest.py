"""Narrow networks whose every value is random, so that two of them never agree by chance."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from psiamfcpp.models import SiamFCpp
from psiamfcpp.spec import FULL_WIDTHS, ModelSpec

MakeNetwork = Callable[..., SiamFCpp]

UNEVEN = {name: 3 + number % 4 for number, name in enumerate(FULL_WIDTHS)}


def randomize(network: SiamFCpp, seed: int) -> SiamFCpp:
    """Random weights of a steady signal, and BatchNorm statistics that are not the identity."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, value in network.state_dict().items():
            if name.endswith("running_var") or name.endswith("bn.weight"):
                value.uniform_(0.5, 1.5, generator=generator)
            elif value.ndim == 4:
                value.normal_(0, (1 / value[0].numel()) ** 0.5, generator=generator)
            elif value.is_floating_point():
                value.normal_(0, 0.3, generator=generator)
        network.backbone.conv1.conv.weight /= 100
    return network.eval()


@pytest.fixture(scope="session")
def make_network() -> MakeNetwork:
    """A network of uneven narrow widths, or of the given ones."""

    def make(seed: int = 0, widths: dict[str, int] | None = None, search_size: int = 303) -> SiamFCpp:
        return randomize(SiamFCpp(ModelSpec(widths=widths or UNEVEN, search_size=search_size)), seed)

    return make


@pytest.fixture(scope="session")
def full_network(make_network: MakeNetwork) -> SiamFCpp:
    return make_network(1, dict(FULL_WIDTHS))


@pytest.fixture
def crops() -> Callable[..., torch.Tensor]:
    """Random crops ``(B, 3, S, S)`` of grey levels 0..255."""

    def make(batch: int, size: int, seed: int = 0) -> torch.Tensor:
        return torch.rand(batch, 3, size, size, generator=torch.Generator().manual_seed(seed)) * 255

    return make
