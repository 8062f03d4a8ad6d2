from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from psiamfcpp.models import SiamFCpp
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE


@pytest.fixture(scope="session")
def full_network(make_network: Callable[..., SiamFCpp]) -> SiamFCpp:
    return make_network(1, dict(ARCHITECTURE.groups))


@pytest.fixture
def crops() -> Callable[..., torch.Tensor]:
    """Random crops ``(B, 3, S, S)`` of grey levels 0..255."""

    def make(batch: int, size: int, seed: int = 0) -> torch.Tensor:
        return torch.rand(batch, 3, size, size, generator=torch.Generator().manual_seed(seed)) * 255

    return make
