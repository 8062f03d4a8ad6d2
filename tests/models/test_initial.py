from __future__ import annotations

import pytest
import torch

from psiamfcpp.models import SiamFCpp
from psiamfcpp.models.initial import init_neck_and_head
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.spec import ModelSpec


def fresh(seed: int, torch_seed: int = 0) -> SiamFCpp:
    torch.manual_seed(torch_seed)
    network = SiamFCpp(ModelSpec(widths=dict.fromkeys(ARCHITECTURE.groups, 24), search_size=239))
    init_neck_and_head(network, seed)
    return network


@pytest.mark.parametrize(("seed", "equal"), [(4, True), (5, False)])
def test_the_seed_alone_decides_neck_and_head(seed: int, equal: bool):
    one, other = fresh(4).state_dict(), fresh(seed, torch_seed=1).state_dict()
    for name in one:
        if name.startswith(("neck.", "head.")) and name.endswith("conv.weight"):
            assert torch.equal(one[name], other[name]) is equal, name
        elif not name.startswith("backbone."):
            assert torch.equal(one[name], other[name]), name


def test_the_backbone_is_left_alone():
    torch.manual_seed(0)
    untouched = SiamFCpp(ModelSpec(widths=dict.fromkeys(ARCHITECTURE.groups, 24), search_size=239))
    assert torch.equal(untouched.backbone.conv1.conv.weight, fresh(3).backbone.conv1.conv.weight)


@pytest.fixture(scope="module")
def first_maps() -> tuple[torch.Tensor, ...]:
    """What a fresh network says while training, of random crops."""
    network = fresh(0).train()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        template = network.template(torch.rand(8, 3, 127, 127, generator=generator) * 255)
        return network.maps(network.backbone(torch.rand(8, 3, 239, 239, generator=generator) * 255), template)


def test_the_class_starts_at_a_hundredth(first_maps):
    cls = torch.sigmoid(first_maps[0])
    assert cls.median().item() == pytest.approx(0.01, rel=0.3)
    assert 0.005 < cls.mean() < 0.03


def test_centerness_starts_undecided(first_maps):
    assert torch.sigmoid(first_maps[1]).median().item() == pytest.approx(0.5, abs=0.1)


def test_distances_start_at_27_pixels(first_maps):
    assert first_maps[2].median().item() == pytest.approx(8 * 2.718281828**1.2, rel=0.1)
    assert 5 < first_maps[2].quantile(0.01) < first_maps[2].quantile(0.99) < 120
