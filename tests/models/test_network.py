from __future__ import annotations

import math
from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor, nn

from psiamfcpp.models import SiamFCpp
from psiamfcpp.models.cost import count_parameters, search_macs
from psiamfcpp.models.network import cell_grid, depthwise_correlation, to_boxes
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.spec import ModelSpec

PRUNED = dict(
    zip(ARCHITECTURE.groups, (76, 224, 337, 334, 256, 256, 256, 230, 138, 224, 227, 145, 224), strict=True),
)


@dataclass
class Pass:
    """What hooks saw while crops went through the network."""

    sides: dict[str, list[int]] = field(default_factory=dict)
    lowest: dict[str, float] = field(default_factory=dict)
    head_input: int = 0
    macs: int = 0


@torch.no_grad()
def observe(network: SiamFCpp, search_size: int) -> tuple[Pass, Pass]:
    """The template pass and the search pass, seen by hooks."""
    seen = Pass()

    def look(name: str, module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        if isinstance(module, nn.Conv2d):
            seen.macs += output.numel() * module.weight[0].numel()
            return
        seen.sides.setdefault(name, []).append(output.shape[-1])
        seen.lowest[name] = float(output.min())
        if name == "head.cls1":
            seen.head_input = inputs[0].shape[-1]

    hooks = [
        module.register_forward_hook(lambda m, i, o, name=name: look(name, m, i, o))
        for name, module in network.named_modules()
        if isinstance(module, nn.Conv2d | nn.MaxPool2d) or hasattr(module, "conv")
    ]
    generator = torch.Generator().manual_seed(0)
    try:
        kernels = network.template(torch.rand(1, 3, 127, 127, generator=generator) * 255)
        template, seen = seen, Pass()
        network.search(torch.rand(1, 3, search_size, search_size, generator=generator) * 255, kernels)
    finally:
        for hook in hooks:
            hook.remove()
    seen.macs += sum(k.numel() * seen.head_input**2 for k in kernels)
    return template, seen


@pytest.fixture(scope="module")
def full_pass(full_network: SiamFCpp) -> tuple[Pass, Pass]:
    return observe(full_network, 303)


@pytest.mark.parametrize(
    ("name", "template", "search"),
    [
        ("backbone.conv1", [59], [147]),
        ("backbone.pool", [29, 12], [73, 34]),
        ("backbone.conv2", [25], [69]),
        ("backbone.conv3", [10], [32]),
        ("backbone.conv4", [8], [30]),
        ("backbone.conv5", [6], [28]),
        ("neck.cls_template", [4], None),
        ("neck.reg_template", [4], None),
        ("neck.cls_search", None, [26]),
        ("neck.reg_search", None, [26]),
        ("head.cls1", None, [21]),
        ("head.reg1", None, [21]),
        ("head.cls2", None, [19]),
        ("head.reg2", None, [19]),
        ("head.cls3", None, [17]),
        ("head.reg3", None, [17]),
        ("head.cls_score", None, [17]),
        ("head.centerness", None, [17]),
        ("head.reg_offsets", None, [17]),
    ],
)
def test_layer_sizes_are_those_of_the_design(full_pass, name: str, template, search):
    assert full_pass[0].sides.get(name) == template
    assert full_pass[1].sides.get(name) == search


def test_correlation_gives_23(full_pass):
    assert full_pass[1].head_input == 23


@pytest.mark.parametrize(
    ("rectified", "names"),
    [
        (True, [f"backbone.conv{i}" for i in range(1, 5)]),
        (True, [f"head.{branch}{i}" for branch in ("cls", "reg") for i in (1, 2, 3)]),
        (False, ["backbone.conv5", "neck.cls_search", "neck.reg_search", "head.reg_offsets"]),
    ],
)
def test_layers_end_in_relu_where_the_design_has_it(full_pass, rectified: bool, names: list[str]):
    for name in names:
        assert (full_pass[1].lowest[name] >= 0) is rectified, name


def test_batchnorm_follows_every_block_but_the_first_two_of_each_head(full_network: SiamFCpp):
    blocks = {name for name, module in full_network.named_modules() if hasattr(module, "conv")}
    without = {name for name in blocks if f"{name}.bn.weight" not in full_network.state_dict()}
    assert without == {"head.cls1", "head.cls2", "head.reg1", "head.reg2"}


@pytest.mark.parametrize(("widths", "count"), [(ARCHITECTURE.groups, 9_655_380), (PRUNED, 7_489_986)])
def test_parameters(make_network, widths: dict[str, int], count: int):
    assert count_parameters(make_network(0, dict(widths))) == count


def test_macs_of_the_full_network_are_those_that_run(full_pass):
    assert search_macs(ModelSpec()) == full_pass[1].macs
    assert round(full_pass[1].macs / 1e9, 2) == 8.56


@pytest.mark.parametrize("search_size", [191, 239, 303])
def test_macs_of_narrow_networks_are_those_that_run(make_network, search_size: int):
    network = make_network(0, search_size=search_size)
    assert search_macs(network.spec) == observe(network, search_size)[1].macs


def test_macs_of_the_pruned_widths():
    assert round(search_macs(ModelSpec(widths=PRUNED)) / 1e9, 2) == 6.47


@pytest.mark.parametrize("kernel_batch", [1, 3])
def test_depthwise_correlation_against_a_loop(kernel_batch: int):
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(3, 2, 6, 5, generator=generator)
    kernels = torch.randn(kernel_batch, 2, 4, 2, generator=generator)
    expected = torch.zeros(3, 2, 3, 4)
    for b in range(3):
        for c in range(2):
            for y in range(3):
                for x in range(4):
                    window = features[b, c, y : y + 4, x : x + 2]
                    expected[b, c, y, x] = (window * kernels[b % kernel_batch, c]).sum()
    torch.testing.assert_close(depthwise_correlation(features, kernels), expected)


@pytest.mark.slow
@pytest.mark.parametrize("kernel_batch", [1, 2])
def test_gradients_of_the_correlation_are_those_of_finite_differences(kernel_batch: int):
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(2, 3, 7, 6, generator=generator, dtype=torch.double, requires_grad=True)
    kernels = torch.randn(kernel_batch, 3, 4, 2, generator=generator, dtype=torch.double, requires_grad=True)
    assert torch.autograd.gradcheck(depthwise_correlation, (features, kernels))


@torch.no_grad()
def test_a_frozen_network_says_the_same(make_network, crops):
    network = make_network()
    for bn in (m for m in network.modules() if isinstance(m, nn.BatchNorm2d)):
        bn.running_mean.normal_()
        bn.running_var.uniform_(0.5, 2)
    z, x = crops(2, 127, 1), crops(2, 239, 2)
    free, frozen = network.maps(network.backbone(x), network.template(z)), network.requires_grad_(False)
    for a, b in zip(free, frozen.maps(frozen.backbone(x), frozen.template(z)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("search_size", "cells", "last"), [(303, 17, 215), (239, 9, 151)])
def test_cells_stand_every_8_pixels_about_the_middle(search_size: int, cells: int, last: int):
    grid = cell_grid(search_size, cells)
    assert grid[0, 0].tolist() == [87, 87]
    assert grid[0, 1].tolist() == [95, 87]
    assert grid[1, 0].tolist() == [87, 95]
    assert grid[-1, -1].tolist() == [last, last]
    assert grid[cells // 2, cells // 2].tolist() == [(search_size - 1) / 2] * 2


def test_boxes_from_distances():
    distances = torch.zeros(1, 17, 17, 4)
    distances[0, 1, 2] = torch.tensor([1.0, 2.0, 3.0, 4.0])
    boxes = to_boxes(distances, 303)
    assert boxes[0, 1, 2].tolist() == [103 - 1, 95 - 2, 103 + 3, 95 + 4]
    assert boxes[0, 0, 0].tolist() == [87, 87, 87, 87]


@pytest.mark.parametrize(
    ("si", "bi", "expected"),
    [
        (1.0, 0.0, [8, 16, 24, 8 * math.exp(6)]),
        (2.0, math.log(0.5), [4, 16, 36, 8 * math.exp(6)]),
    ],
)
def test_distances_are_eight_times_the_exponential_of_the_offsets(make_network, crops, si, bi, expected):
    network = make_network()
    with torch.no_grad():
        network.head.reg_offsets.bn.weight.zero_()
        network.head.reg_offsets.bn.bias.copy_(torch.tensor([0.0, math.log(2), math.log(3), 100.0]))
        network.head.si.fill_(si)
        network.head.bi.fill_(bi)
        _, _, distances = network.maps(network.backbone(crops(1, 191)), network.template(crops(1, 127)))
    torch.testing.assert_close(distances, torch.tensor(expected).expand(1, 3, 3, 4))


@torch.no_grad()
def test_scores_are_the_product_of_two_probabilities(make_network, crops):
    network = make_network()
    kernels = network.template(crops(2, 127))
    cls, centerness, _ = network.maps(network.backbone(crops(2, 303)), kernels)
    scores, _ = network.search(crops(2, 303), kernels)
    torch.testing.assert_close(scores, 1 / ((1 + torch.exp(-cls)) * (1 + torch.exp(-centerness))))
    assert 0 <= scores.min() < scores.max() <= 1


@pytest.mark.parametrize(("search_size", "cells"), [(191, 3), (239, 9), (303, 17)])
@torch.no_grad()
def test_map_sizes(make_network, crops, search_size: int, cells: int):
    network = make_network()
    scores, boxes = network.search(crops(1, search_size), network.template(crops(1, 127)))
    assert scores.shape == (1, cells, cells)
    assert boxes.shape == (1, cells, cells, 4)


@torch.no_grad()
def test_forward_is_template_then_search(make_network, crops):
    network = make_network()
    z, x = crops(2, 127, 1), crops(2, 239, 2)
    for together, apart in zip(network(z, x), network.search(x, network.template(z)), strict=True):
        assert torch.equal(together, apart)


@torch.no_grad()
def test_a_batch_equals_its_samples_one_by_one(make_network, crops):
    network = make_network()
    z, x = crops(2, 127, 1), crops(2, 239, 2)
    together = network(z, x)
    for i in range(2):
        for whole, single in zip(together, network(z[i : i + 1], x[i : i + 1]), strict=True):
            torch.testing.assert_close(whole[i], single[0])


@torch.no_grad()
def test_one_template_serves_a_batch_of_crops(make_network, crops):
    network = make_network()
    z, x = crops(1, 127, 1), crops(3, 239, 2)
    shared = network.search(x, network.template(z))
    repeated = network.search(x, network.template(z.expand(3, -1, -1, -1)))
    for a, b in zip(shared, repeated, strict=True):
        torch.testing.assert_close(a, b)


@torch.no_grad()
def test_the_score_depends_on_the_template(make_network, crops):
    network = make_network()
    x = crops(1, 239, 2)
    one, other = (network(crops(1, 127, seed), x)[0] for seed in (3, 4))
    assert not torch.allclose(one, other)
