"""Ranks against numpy and by hand, on constructed maps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional

from psiamfcpp.errors import UserError
from psiamfcpp.models import SiamFCpp
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.pruning import rank
from psiamfcpp.pruning.groups import Group, find_groups
from psiamfcpp.pruning.models import groups_of
from psiamfcpp.pruning.ranking import map_ranks
from psiamfcpp.spec import ModelSpec

from .conftest import WIDTHS


def of_rank(k: int, height: int, width: int, seed: int = 0) -> torch.Tensor:
    """A map that is a sum of k outer products with singular values between 1 and 2."""
    rng = np.random.default_rng(seed)
    left, _ = np.linalg.qr(rng.standard_normal((height, height)))
    right, _ = np.linalg.qr(rng.standard_normal((width, width)))
    return torch.tensor(left[:, :k] @ np.diag(np.linspace(1, 2, k)) @ right[:k], dtype=torch.float32)


@pytest.mark.parametrize(("height", "width"), [(147, 147), (17, 17), (12, 30), (1, 5)])
def test_rank_of_constructed_maps(height: int, width: int) -> None:
    full = min(height, width)
    wanted = sorted({0, 1, full // 3, full - 1, full})
    maps = torch.stack([of_rank(k, height, width, seed=k) for k in wanted])
    assert map_ranks(maps).tolist() == wanted
    assert [np.linalg.matrix_rank(m) for m in maps.numpy()] == wanted


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.floats(1e-6, 1e6), st.integers(2, 40))
def test_ranks_are_numpys_whatever_the_scale(seed: int, scale: float, side: int) -> None:
    rng = np.random.default_rng(seed)
    # As after ReLU: mostly zeros, some rows empty, some repeated.
    maps = np.maximum(rng.standard_normal((6, side, side)) - 1, 0) * scale
    maps[:, 0] = 0
    maps[:, -1] = maps[:, side // 2]
    maps = maps.astype(np.float32)
    assert map_ranks(torch.from_numpy(maps)).tolist() == np.linalg.matrix_rank(maps).tolist()


def test_a_constant_map_has_rank_one_and_noise_below_float32_does_not_count() -> None:
    flat = torch.full((30, 30), 7.0)
    assert map_ranks(torch.stack([flat, flat * (1 + 1e-7 * torch.randn(30, 30)), flat + torch.eye(30)])).tolist() == [
        1,
        1,
        30,
    ]


class Passing(nn.Module):
    """Hands its input's channels on, scaled: so the maps are known."""

    def __init__(self, *after: nn.Module):
        super().__init__()
        self.conv = nn.Conv2d(3, 3, 1, groups=3)
        nn.init.constant_(self.conv.weight, 2.0)
        nn.init.zeros_(self.conv.bias)  # type: ignore[arg-type]
        self.after = nn.Sequential(*after)
        self.last = nn.Conv2d(3, 2, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(self.after(self.conv(x)))


def test_ranks_are_means_over_images_of_all_batches() -> None:
    images = torch.stack(
        [torch.stack([of_rank(k, 9, 9) for k in ranks]) for ranks in [(0, 1, 9), (0, 5, 9), (0, 3, 9)]]
    )
    table = rank(Passing(), [images[:2], images[2:]])
    assert table.images == 3
    assert list(table.groups) == ["conv"]
    group = table.groups["conv"]
    assert group.rank.tolist() == [0, 3, 9]
    assert (group.max, group.dead, group.flat) == (9, 1, False)


class Called(nn.Module):
    """A function in place of a module, as many networks call ReLU in their forward."""

    def __init__(self, function: Callable[[torch.Tensor], torch.Tensor]) -> None:
        super().__init__()
        self.forward = function


@pytest.mark.parametrize(
    "after",
    [
        (nn.ReLU(),),
        (Called(functional.relu),),
        (Called(torch.relu_),),
        (Called(lambda x: x.clamp(min=0)),),
        (nn.BatchNorm2d(3), Called(torch.Tensor.relu), Called(lambda x: x + 1)),
        (nn.ReLU(inplace=True),),
        (nn.BatchNorm2d(3), nn.ReLU()),
        (nn.ReLU(), nn.MaxPool2d(3, 3)),
        (nn.LeakyReLU(0.0), nn.Dropout2d(0.5)),
    ],
    ids=lambda after: "+".join(type(m).__name__ for m in after),
)
def test_the_map_that_counts_is_that_after_norm_and_activation_but_before_a_pool(after: tuple[nn.Module, ...]) -> None:
    # Negative everywhere but in one corner: after ReLU rank 4, where it was full before.
    x = -torch.rand(1, 3, 9, 9, generator=torch.Generator().manual_seed(0)) - 0.1
    x[:, :, :4, :4] *= -1
    table = rank(Passing(*after), [x])
    assert table.groups["conv"].rank.tolist() == [4, 4, 4]
    assert table.groups["conv"].max == 9


def test_what_writes_into_a_map_afterwards_does_not_count() -> None:
    class Adding(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.conv, self.last, self.relu = nn.Conv2d(3, 3, 1), nn.Conv2d(3, 1, 1), nn.ReLU()
            nn.init.zeros_(self.conv.weight)
            nn.init.zeros_(self.conv.bias)  # type: ignore[arg-type]

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            y = self.conv(x)
            y += x
            return self.last(self.relu(y))

    assert rank(Adding(), [torch.rand(1, 3, 9, 9)]).groups["conv"].dead == 3


def test_a_module_used_twice_is_followed_each_time(residual: nn.Module) -> None:
    # Block.relu serves conv1 and the sum.
    table = rank(residual, [torch.rand(2, 3, 12, 12)])
    assert {name: len(g.rank) for name, g in table.groups.items()} == {
        "stem.0": 16,
        "blocks.0.conv1": 24,
        "blocks.1.conv1": 32,
        "last.0": 12,
    }
    assert table.groups["last.0"].max == 10


def test_groups_of_a_residual_network_with_grouped_convolutions(residual: nn.Module) -> None:
    groups = find_groups(residual, torch.rand(1, 3, 12, 12))
    assert groups["stem.0"] == Group(("stem.0", "blocks.0.conv2", "blocks.1.conv2"), 16, parts=4)
    assert groups["blocks.0.conv1"] == Group(("blocks.0.conv1",), 24, parts=4)
    assert groups["last.0"] == Group(("last.0",), 12)


def test_the_dependency_graph_finds_our_thirteen_groups(siamese: SiamFCpp, pair: tuple[torch.Tensor, ...]) -> None:
    ours = groups_of(ModelSpec(widths=dict(WIDTHS)))
    found = find_groups(siamese, tuple(crop[:1] for crop in pair))
    assert list(ours) == list(ARCHITECTURE.groups)
    as_ours = {tuple(b.removesuffix(".conv") for b in g.blocks): g.width for g in found.values()}
    assert as_ours == {group.blocks: group.width for group in ours.values()}


def test_views_of_template_and_search_and_their_mean(siamese: SiamFCpp, pair: tuple[torch.Tensor, ...]) -> None:
    groups = groups_of(ModelSpec(widths=dict(WIDTHS)))
    table = rank(siamese, [pair], groups)
    with torch.no_grad():
        z = siamese.backbone.conv1(pair[0]).numpy()
        x = siamese.neck.cls_search(siamese.backbone(pair[1])).numpy()
    conv1, neck, head = (table.groups[name] for name in ("backbone.conv1", "neck.cls", "head.reg2"))
    assert {k: v.max for k, v in conv1.views.items()} == {"template": 59, "search": 91}
    assert conv1.max == 75
    assert conv1.views["template"].rank.tolist() == np.linalg.matrix_rank(z).mean(axis=0).tolist()
    assert neck.views["search"].rank.tolist() == np.linalg.matrix_rank(x).mean(axis=0).tolist()
    for group in (conv1, neck):
        means = (group.views["template"].rank + group.views["search"].rank) / 2
        assert group.rank.tolist() == means.tolist()
    assert list(head.views) == ["search"]
    assert table.groups["neck.reg"].norm is not None and len(table.groups["neck.reg"].norm) == WIDTHS["neck.reg"]


def test_ranking_leaves_the_network_as_it_was(residual: nn.Module) -> None:
    residual.train()
    residual.stem.eval()
    residual.requires_grad_(False)
    before = {k: v.clone() for k, v in residual.state_dict().items()}
    rank(residual, [torch.rand(2, 3, 12, 12)])
    assert residual.training and not residual.stem.training
    assert not any(p.requires_grad for p in residual.parameters())
    assert all(torch.equal(v, before[k]) for k, v in residual.state_dict().items())
    assert not any(m._forward_hooks or m._forward_pre_hooks for m in residual.modules())


@pytest.mark.parametrize(
    ("batches", "groups", "message"),
    [
        ([], None, "no image"),
        ([], {"conv": Group(("conv",), 3)}, "no image"),
        ([torch.full((1, 3, 5, 5), float("nan"))], None, "not finite"),
        ([torch.rand(1, 3, 5, 5)], {"x": Group(("cnv",), 3)}, "no module 'cnv'"),
        ([torch.rand(1, 3, 5, 5)], {"x": Group(("after",), 3)}, "no convolution"),
        ([torch.rand(1, 7, 5, 5)], None, "cannot trace"),
    ],
)
def test_refusals(batches: list[torch.Tensor], groups: dict[str, Group] | None, message: str) -> None:
    with pytest.raises(UserError, match=message):
        rank(Passing(nn.ReLU()), batches, groups)
