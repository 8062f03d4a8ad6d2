"""What is left after pruning computes what it computed before."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import pytest
import torch
import torch.nn.utils.prune
from torch import nn

from psiamfcpp.errors import UserError
from psiamfcpp.models import SiamFCpp
from psiamfcpp.models.cost import count_parameters
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.pruning import Plan, plan, prune, rank
from psiamfcpp.pruning.groups import find_groups
from psiamfcpp.pruning.models import groups_of, prune_model
from psiamfcpp.spec import Calibration, ModelSpec

from .conftest import WIDTHS, randomize, silence

Pair = tuple[torch.Tensor, torch.Tensor]


def some(widths: dict[str, int], seed: int = 0) -> Plan:
    """About half of each group's filters."""
    generator = torch.Generator().manual_seed(seed)
    return Plan({n: torch.randperm(w, generator=generator)[: max(1, w // 2)].tolist() for n, w in widths.items()})


def run(model: nn.Module, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
    with torch.no_grad():
        out = model(*inputs)
    return out if isinstance(out, tuple) else (out,)


def test_keeping_everything_changes_no_bit(siamese: SiamFCpp, pair: Pair) -> None:
    whole = Plan({name: list(range(width)) for name, width in WIDTHS.items()})
    pruned = prune_model(siamese, whole)
    assert pruned is not siamese
    assert pruned.spec == siamese.spec
    state = pruned.state_dict()
    assert state.keys() == siamese.state_dict().keys()
    assert all(torch.equal(value, state[key]) for key, value in siamese.state_dict().items())
    assert all(torch.equal(a, b) for a, b in zip(run(siamese, *pair), run(pruned, *pair), strict=True))


@pytest.mark.parametrize("group", [*ARCHITECTURE.groups, "all"])
def test_a_pruned_network_is_the_full_one_with_those_filters_silenced(
    siamese: SiamFCpp, pair: Pair, group: str
) -> None:
    groups = groups_of(ModelSpec(widths=dict(WIDTHS)))
    chosen = some(WIDTHS if group == "all" else {group: WIDTHS[group]})
    pruned = prune_model(siamese, chosen)
    assert pruned.spec.widths == {**WIDTHS, **chosen.widths}
    before = run(siamese, *pair)
    silence(siamese, chosen, groups)
    wanted, found = run(siamese, *pair), run(pruned, *pair)
    # Silencing is felt, or this would show nothing.
    assert max((a - b).abs().max() for a, b in zip(before, wanted, strict=True)) > 1e-4
    torch.testing.assert_close(found[0], wanted[0], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(found[1], wanted[1], atol=1e-2, rtol=1e-4)


def test_filters_whose_maps_are_zero_go_without_a_trace(siamese: SiamFCpp, pair: Pair) -> None:
    dead = {
        "backbone.conv1": 1,
        "backbone.conv3": 0,
        "head.cls2": 3,
        "head.reg3": 2,
        "neck.cls": 1,
        "backbone.conv5": 2,
    }
    with torch.no_grad():
        for name, number in dead.items():
            for block_name in groups_of(ModelSpec(widths=dict(WIDTHS)))[name].blocks:
                block = siamese.get_submodule(block_name)
                block.conv.weight[number] = 0
                block.conv.bias[number] = 0
                if block.bn is not None:
                    # Below zero before ReLU, zero where there is none.
                    block.bn.bias[number] = -1 if block.relu else 0
                    block.bn.running_mean[number] = 0
    table = rank(siamese, [pair], groups_of(ModelSpec(widths=dict(WIDTHS))))
    assert all(table.groups[name].rank[number] == 0 for name, number in dead.items())
    chosen = Plan({name: [f for f in range(WIDTHS[name]) if f != number] for name, number in dead.items()})
    before, after = run(siamese, *pair), run(prune_model(siamese, chosen), *pair)
    assert (before[0] - after[0]).abs().max() < 1e-5
    assert (before[1] - after[1]).abs().max() < 1e-2  # pixels of boxes of up to thousands
    torch.testing.assert_close(before[1], after[1], atol=1e-3, rtol=1e-5)


def test_spec_keeps_all_but_the_widths() -> None:
    spec = ModelSpec(
        widths=dict(WIDTHS), search_size=239, calibration=Calibration(bias=2.0), provenance={"training": ["x"]}
    )
    model = randomize(SiamFCpp(spec))
    pruned = prune_model(model, Plan({"head.cls1": [1]}))
    assert pruned.spec.widths == {**WIDTHS, "head.cls1": 1}
    assert (pruned.spec.search_size, pruned.spec.calibration, pruned.spec.constants, pruned.spec.provenance) == (
        239,
        spec.calibration,
        spec.constants,
        spec.provenance,
    )
    assert model.spec is spec and model.head.cls1.conv.out_channels == WIDTHS["head.cls1"]
    assert not pruned.training and prune_model(model.train(), Plan({"head.cls1": [1]})).training


@pytest.mark.slow
def test_the_papers_plan_gives_the_papers_parameters() -> None:
    from psiamfcpp.models.siamfcpp_alexnet import PAPER_KEEP
    from psiamfcpp.pruning.planning import kept_count

    model = SiamFCpp()
    keep = {name: list(range(kept_count(name, ARCHITECTURE.groups[name], share))) for name, share in PAPER_KEEP.items()}
    assert count_parameters(model) == 9_655_380
    assert count_parameters(prune_model(model, Plan(keep))) == 7_489_986


@pytest.mark.parametrize("name", ["stem.0", "blocks.0.conv1", "blocks.1.conv1", "last.0", "all"])
def test_a_residual_network_with_grouped_convolutions(residual: nn.Module, example: ModuleType, name: str) -> None:
    x = torch.rand(3, 3, 14, 14, generator=torch.Generator().manual_seed(1))
    table = rank(residual, [x])
    chosen = plan(table, keep=dict.fromkeys(table.groups if name == "all" else [name], 0.5))
    pruned = prune(residual, x[:1], chosen)
    assert {n: g.width for n, g in find_groups(pruned, x).items()} == chosen.widths
    # Silence: what BatchNorm makes of the removed filters' maps is zero, and so is every sum they enter.
    for group, filters in chosen.keep.items():
        removed = sorted(set(range(table.widths[group])) - set(filters))
        for block in find_groups(residual, x)[group].blocks:
            after = block.replace("conv", "bn") if "conv" in block else block[:-1] + "1"
            layer = residual.get_submodule(block if group == "last.0" else after)
            with torch.no_grad():
                layer.weight[removed] = 0
                layer.bias[removed] = 0
    torch.testing.assert_close(run(pruned, x), run(residual, x), atol=1e-5, rtol=1e-5)


def test_a_residual_network_kept_whole(residual: nn.Module) -> None:
    x = torch.rand(2, 3, 12, 12)
    table = rank(residual, [x])
    assert torch.equal(run(prune(residual, x, plan(table)), x)[0], run(residual, x)[0])


def test_parts_of_a_grouped_convolution_must_keep_the_same_positions(residual: nn.Module) -> None:
    x = torch.rand(1, 3, 12, 12)
    good = [position + 6 * part for part in range(4) for position in (0, 2, 5)]
    assert prune(residual, x, Plan({"blocks.0.conv1": good})).blocks[0].conv1.weight.shape == (12, 4, 3, 3)
    with pytest.raises(UserError, match=r"blocks\.0\.conv1 feeds a grouped convolution"):
        prune(residual, x, Plan({"blocks.0.conv1": [*good[:-1], 22]}))


def test_plans_for_another_network_are_refused(siamese: SiamFCpp) -> None:
    with pytest.raises(UserError, match=r"filter 96 of backbone\.conv1, which has 4"):
        prune_model(siamese, Plan({"backbone.conv1": [0, 96]}))
    with pytest.raises(UserError, match="names conv9"):
        prune_model(siamese, Plan({"conv9": [0]}))


@pytest.mark.slow
def test_the_example_runs(example: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    example.main()
    printed = capsys.readouterr().out
    rows = [line.replace(",", "").split() for line in printed.splitlines() if "parameters" in line]
    parameters, off = [int(row[1]) for row in rows], [float(row[-1]) for row in rows]
    assert parameters[0] == sum(p.numel() for p in example.Net().parameters())
    assert parameters[1] == parameters[2] < 0.5 * parameters[0]
    assert off[0] == 0 < off[2] < 0.2 * off[1]


class Shuffle(nn.Module):
    """A convolution, its channels in another order, and a convolution that reads them."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.o = nn.Conv2d(3, 8, 3), nn.Conv2d(8, 2, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        a = self.a(x)
        b, c, h, w = a.shape
        return self.o(a.view(b, 2, c // 2, h, w).transpose(1, 2).reshape(b, c, h, w))


class Counting(nn.Module):
    """A mean over channels, which changes with their number."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.o = nn.Conv2d(3, 8, 3), nn.Conv2d(1, 2, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.o(self.a(x).mean(dim=1, keepdim=True))


class Fixed(nn.Module):
    """A reshape to a number of channels that is written down."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.o = nn.Conv2d(3, 8, 3), nn.Conv2d(8, 2, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        a = self.a(x)
        return self.o(a.reshape(len(x), 8, *a.shape[2:]))


@pytest.mark.parametrize("network", [Shuffle, Counting, Fixed])
def test_cuts_that_change_what_the_kept_filters_do_are_refused(network: type[nn.Module]) -> None:
    torch.manual_seed(0)
    with pytest.raises(UserError, match=r"without the removed filters of a, .*keep these groups whole"):
        prune(network().eval(), torch.rand(1, 3, 16, 16), Plan({"a": [0, 2, 4, 6]}))
    assert prune(network(), torch.rand(1, 3, 16, 16), Plan({"a": list(range(8))})).a.out_channels == 8


@pytest.mark.parametrize("norm", [nn.GroupNorm(2, 8), nn.BatchNorm2d(8), nn.InstanceNorm2d(8, affine=True)])
def test_norms_over_several_channels_take_their_statistics_over_those_that_are_left(norm: nn.Module) -> None:
    torch.manual_seed(0)
    network = randomize(nn.Sequential(nn.Conv2d(3, 8, 3), norm, nn.ReLU(), nn.Flatten(), nn.Linear(8 * 36, 2)))
    pruned = prune(network, torch.rand(1, 3, 8, 8), Plan({"0": [0, 2, 4, 6]}))
    assert (pruned[0].out_channels, pruned[4].in_features) == (4, 4 * 36)


def test_networks_with_inputs_by_name_are_checked_as_well() -> None:
    class Named(Shuffle):
        def forward(self, image: torch.Tensor) -> dict[str, list[torch.Tensor]]:  # type: ignore[override]
            return {"maps": [self.o(self.a(image))]}

    assert prune(Named().eval(), {"image": torch.rand(1, 3, 9, 9)}, Plan({"a": [1, 3]})).a.out_channels == 2


def test_inference_mode_is_refused() -> None:
    network, x = nn.Sequential(nn.Conv2d(3, 8, 3), nn.ReLU(), nn.Conv2d(8, 2, 1)), torch.rand(1, 3, 9, 9)
    with torch.inference_mode():
        for act in (lambda: find_groups(network, x), lambda: prune(network, x, Plan({"0": [0]}))):
            with pytest.raises(UserError, match="inference_mode"):
                act()


def masked(layer: nn.Module) -> None:
    torch.nn.utils.prune.l1_unstructured(layer, "weight", 0.3)


def masked_bias(layer: nn.Module) -> None:
    torch.nn.utils.prune.random_unstructured(layer, "bias", 0.3)


@pytest.mark.parametrize(
    "change", [masked, masked_bias, torch.nn.utils.parametrizations.weight_norm, torch.nn.utils.spectral_norm]
)
def test_masked_and_parametrized_weights_must_be_made_permanent_first(change: Any) -> None:
    network, x = nn.Sequential(nn.Conv2d(3, 8, 3), nn.ReLU(), nn.Conv2d(8, 2, 1)).eval(), torch.rand(1, 3, 9, 9)
    change(network[0])
    with pytest.raises(UserError, match=r"of 0 is computed from other tensors.*make it permanent first"):
        prune(network, x, Plan({"0": [0, 2]}))
    if change is masked:
        torch.nn.utils.prune.remove(network[0], "weight")
        assert prune(network, x, Plan({"0": [0, 2]}))[0].out_channels == 2


def test_a_depthwise_layer_of_several_outputs_cannot_be_cut() -> None:
    network = nn.Sequential(nn.Conv2d(3, 8, 3), nn.Conv2d(8, 16, 3, groups=8), nn.Conv2d(16, 2, 1))
    x = torch.rand(1, 3, 9, 9)
    name, group = next(iter(find_groups(network, x).items()))
    with pytest.raises(UserError, match="depthwise convolution with several outputs"):
        prune(network, x, Plan({name: list(range(1, group.width))}))


def test_a_printed_group_says_what_is_tied_to_what(residual: nn.Module) -> None:
    groups = find_groups(residual, torch.rand(1, 3, 12, 12))
    assert str(groups["stem.0"]) == (
        "stem.0: 16 filters; tied in stem.0, blocks.0.conv2, blocks.1.conv2; the same positions in each of 4 parts; "
        "read by blocks.0.conv1, blocks.1.conv1, last.0"
    )
    assert str(groups["last.0"]) == "last.0: 12 filters; read by classifier"
    ours = groups_of(ModelSpec())
    assert str(ours["neck.cls"]) == (
        "neck.cls: 256 filters; tied in neck.cls_template, neck.cls_search; read by head.cls1"
    )
    assert str(ours["backbone.conv5"]).endswith(
        "read by neck.cls_template, neck.cls_search, neck.reg_template, neck.reg_search"
    )
