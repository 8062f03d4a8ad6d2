"""Weights in 8 bits give nearly the same numbers, by the same nodes, from half of the bytes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from psiamfcpp import zoo
from psiamfcpp.export.compact import compact
from psiamfcpp.export.graph import Ranges, search_graph, template_graph
from psiamfcpp.export.layers import Layer, layers
from psiamfcpp.models.network import SiamFCpp
from psiamfcpp.runtime.onnx_engine import open_session

onnx = pytest.importorskip("onnx")


def arrays(graph: onnx.ModelProto) -> dict[str, np.ndarray]:
    return {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.graph.initializer}


@pytest.fixture(scope="module")
def network(make_network: Callable[..., SiamFCpp]) -> SiamFCpp:
    return make_network(3)


def test_large_weights_keep_a_step_and_a_half_of_their_filter(network: SiamFCpp) -> None:
    weights = layers(network)
    weights["neck.cls_template"].weight[1] = 0  # a filter that pruning filled up
    graph = template_graph(network.spec, weights, Ranges())
    before = graph.SerializeToString()
    small = compact(graph)
    assert graph.SerializeToString() == before
    onnx.checker.check_model(small, full_check=True)
    assert [node.op_type for node in small.graph.node] == [node.op_type for node in graph.graph.node]
    stored, sizes = arrays(small), {name: a.size for name, a in arrays(graph).items() if name.endswith(".weight")}
    large = {name for name, size in sizes.items() if size >= sum(sizes.values()) / 10}
    assert 2 < len(large) <= 7
    assert {name: stored[name].dtype for name in sizes} == {
        name: np.int8 if name in large else np.float16 for name in sizes
    }
    for name in large:
        layer: Layer = weights[name.removesuffix(".weight")]
        whole = layer.weight * layer.gain[:, None, None, None]
        found = stored[name].astype(np.float32) * stored[name.replace(".weight", ".scale")]
        peak = np.abs(whole).max(axis=(1, 2, 3), keepdims=True)
        assert (np.abs(found - whole) <= peak * (1.5 / 127 + 1e-3)).all()
    assert not stored["neck.cls_template.weight"][1].any()


def test_a_layer_whose_input_channels_are_uneven_stays_in_16_bits(network: SiamFCpp) -> None:
    def small() -> set[str]:
        stored = arrays(compact(template_graph(network.spec, weights, Ranges())))
        return {name for name, array in stored.items() if array.dtype == np.int8}

    weights = layers(network)
    before = small()
    uneven = max(before)
    weights[uneven.removesuffix(".weight")].weight[:, 1:] *= 0.01
    assert small() == before - {uneven}


def test_kernels_are_close_to_those_of_the_float_graph(network: SiamFCpp) -> None:
    crop = np.random.default_rng(0).integers(0, 256, (1, 127, 127, 3), np.uint8)
    graph = template_graph(network.spec, layers(network), Ranges())
    expected, found = (
        open_session(model.SerializeToString(), 1).run(None, {"crop": crop}) for model in (graph, compact(graph))
    )
    for kernel, other in zip(expected, found, strict=True):
        assert 0 < np.abs(kernel - other).mean() < 0.02 * np.abs(kernel).mean()


def test_quantized_layers_stay_as_they_are(network: SiamFCpp) -> None:
    graph = search_graph(network.spec, layers(network), Ranges({"head.reg_offsets": (0.0, 1.0)}))
    before, after = arrays(graph), arrays(compact(graph))
    quantized = [name for name, array in before.items() if array.dtype == np.int8]
    assert quantized
    assert all(np.array_equal(after[name], before[name]) for name in quantized)


@pytest.mark.parametrize(
    "name",
    [name for name in zoo.graph_names() if name.startswith(("psiamfcpp", "siamfcpp")) and name.endswith("-int8")],
)
def test_shipped_templates_of_8_bit_models_hold_8_bit_weights(name: str) -> None:
    folder = zoo.graph_folder(name)
    assert folder
    stored = [array for key, array in arrays(onnx.load(folder / "template.onnx")).items() if key.endswith(".weight")]
    assert sum(a.size for a in stored if a.itemsize == 1) > 0.4 * sum(a.size for a in stored)
