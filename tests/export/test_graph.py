"""Graphs are the network, layer by layer; in 8 bits they are close to it, and still integers where it counts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from psiamfcpp.datasets import Sequence
from psiamfcpp.demo.clip import DemoFrame
from psiamfcpp.export.builder import Builder
from psiamfcpp.export.crops import Pair, rendered, sample
from psiamfcpp.export.graph import Ranges, search_graph, template_graph
from psiamfcpp.export.layers import Layer, divided, layers
from psiamfcpp.export.quantize import losses, measure, without
from psiamfcpp.models.arch import DEFAULT, architecture
from psiamfcpp.models.network import SiamFCpp
from psiamfcpp.runtime.onnx_engine import open_session
from psiamfcpp.spec import ModelSpec

onnx = pytest.importorskip("onnx")
READERS = architecture(DEFAULT).readers


@pytest.fixture(scope="module")
def network(make_network: Callable[..., SiamFCpp]) -> SiamFCpp:
    # rounded as shipped checkpoints are, which the graphs store without loss
    return make_network(3).half().float()


@pytest.fixture(scope="module")
def pairs(network: SiamFCpp, rendered_clip: list[DemoFrame], tmp_path_factory: pytest.TempPathFactory) -> list[Pair]:
    folder = tmp_path_factory.mktemp("clip")
    for number, shot in enumerate(rendered_clip):
        cv2.imwrite(str(folder / f"{number:02}.png"), shot.image)
    boxes = np.array([shot.box for shot in rendered_clip])
    return sample([Sequence("clip", sorted(folder.iterdir()), boxes)], network.spec, 3)


@pytest.fixture(scope="module")
def ranges(network: SiamFCpp, pairs: list[Pair]) -> Ranges:
    return measure(network.spec, layers(network), pairs)


def answer(network: SiamFCpp, ranges: Ranges, pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    weights = layers(network)
    template = open_session(template_graph(network.spec, weights, Ranges()).SerializeToString(), 1)
    search = open_session(search_graph(network.spec, weights, ranges).SerializeToString(), 1)
    cls, reg = template.run(None, {"crop": pair.template[None]})
    scores, boxes = search.run(None, {"crop": pair.search[None], "cls_kernel": cls, "reg_kernel": reg})
    return scores, boxes


def test_graphs_are_valid_and_describe_themselves(network: SiamFCpp, ranges: Ranges) -> None:
    for graph in (
        template_graph(network.spec, layers(network), Ranges()),
        search_graph(network.spec, layers(network), ranges),
    ):
        onnx.checker.check_model(graph, full_check=True)
        metadata = {entry.key: entry.value for entry in graph.metadata_props}
        assert metadata["format"] == "psiamfcpp-graph/1"
        assert ModelSpec.from_json(metadata["spec"]) == network.spec


def test_float_graphs_compute_the_network_with_folded_batchnorm(network: SiamFCpp, pairs: list[Pair]) -> None:
    import torch

    def as_input(crop: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(crop).permute(2, 0, 1)[None].float()

    scores, boxes = answer(network, Ranges(), pairs[0])
    with torch.inference_mode():
        expected = network.search(as_input(pairs[0].search), network.template(as_input(pairs[0].template)))
    assert_allclose(scores, expected[0], atol=1e-4)
    assert_allclose(boxes, expected[1], rtol=1e-3, atol=0.02)


def test_half_precision_weights_lose_nothing_in_the_graph(make_network: Callable[..., SiamFCpp]) -> None:
    unrounded = make_network(3)
    graph_weights = layers(unrounded)
    model = template_graph(unrounded.spec, graph_weights, Ranges())
    stored = {t.name: onnx.numpy_helper.to_array(t) for t in model.graph.initializer}
    name = "backbone.conv3"
    half = graph_weights[name].weight.astype(np.float16).astype(np.float32)
    again = stored[f"{name}.weight"].astype(np.float32) * stored[f"{name}.scale"]
    folded = graph_weights[name].weight * graph_weights[name].gain[:, None, None, None]
    assert_allclose(again, folded, rtol=6e-4)
    assert np.abs(half - graph_weights[name].weight).max() > 0  # the weights did need rounding


def test_quantized_layers_run_on_integers_and_others_in_float(network: SiamFCpp, ranges: Ranges, tmp_path) -> None:
    import onnxruntime

    def integer_layers(kept: Ranges) -> set[str]:
        graph = search_graph(network.spec, layers(network), kept)
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        options.optimized_model_filepath = str(tmp_path / "optimized.onnx")
        onnxruntime.InferenceSession(graph.SerializeToString(), options, providers=["CPUExecutionProvider"])
        nodes = onnx.load(tmp_path / "optimized.onnx").graph.node
        return {n.name.removesuffix("_nhwc").split("_token")[0] for n in nodes if n.op_type == "QLinearConv"}

    # An integer convolution has an integer output: the last ones, which feed the scores and boxes, stay float.
    last = {"head.scores", "head.reg_offsets"}
    assert integer_layers(ranges) == {*ranges.inputs, "correlation"} - last
    # Nor does the correlation run on integers without its features, nor conv5 and head.cls3, which feed what is kept.
    kept = without(ranges, {"head.scores", "neck.search"})
    assert integer_layers(kept) == set(ranges.inputs) - last - {"neck.search", "backbone.conv5", "head.cls3"}


def test_an_eight_bit_template_sums_in_integers_alone(network: SiamFCpp, ranges: Ranges, tmp_path) -> None:
    # Sums of floats differ by processor, and one bit of a kernel may decide between two like objects.
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.optimized_model_filepath = str(tmp_path / "optimized.onnx")
    graph = template_graph(network.spec, layers(network), ranges)
    onnx.checker.check_model(graph, full_check=True)
    onnxruntime.InferenceSession(graph.SerializeToString(), options, providers=["CPUExecutionProvider"])
    sums = [n.op_type for n in onnx.load(tmp_path / "optimized.onnx").graph.node if "Conv" in n.op_type]
    assert sorted(sums) == ["ConvInteger"] * 2 + ["QLinearConv"] * 5


def test_an_eight_bit_template_is_close_to_the_float_one(network: SiamFCpp, ranges: Ranges, pairs: list[Pair]) -> None:
    expected, found = (
        open_session(template_graph(network.spec, layers(network), some).SerializeToString(), 1).run(
            None, {"crop": pairs[1].template[None]}
        )
        for some in (Ranges(), ranges)
    )
    for kernel, other in zip(expected, found, strict=True):
        assert 0 < np.abs(kernel - other).mean() < 0.1 * np.abs(kernel).mean()


def test_exact_layers_sum_every_product(network: SiamFCpp) -> None:
    # Products of the largest bytes: a sum of two already leaves 16 bits, in which some processors add.
    layer = Layer(np.ones((4, 64, 1, 1), np.float32), np.ones(4, np.float32), np.arange(4, dtype=np.float32))
    graph = Builder({"layer": layer}, Ranges())
    out = graph.exact("layer", "x", (0.0, 255.0))
    given = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 64, 2, 2])
    made = graph.model(network.spec, [given], {"y": (out, onnx.TensorProto.FLOAT, [1, 4, 2, 2])})
    (found,) = open_session(made.SerializeToString(), 1).run(None, {"x": np.full((1, 64, 2, 2), 255, np.float32)})
    assert_allclose(found[0, :, 0, 0], 64 * 255 + layer.bias, rtol=1e-6)


def test_eight_bits_stay_close(network: SiamFCpp, ranges: Ranges, pairs: list[Pair]) -> None:
    expected, found = (answer(network, r, pairs[1]) for r in (Ranges(), ranges))
    assert 0 < np.abs(found[0] - expected[0]).max() < 0.1
    # the exponential makes much of little in random weights' widest boxes, so the median is asked
    assert 0 < np.median(np.abs(found[1] - expected[1])) < 1


def test_kernels_far_from_those_of_the_calibration_keep_their_eight_bits(
    network: SiamFCpp, ranges: Ranges, pairs: list[Pair]
) -> None:
    def logits(some: Ranges, kernels: list[np.ndarray]) -> np.ndarray:
        graph = search_graph(network.spec, layers(network), some)
        tensor = next(n.output[0] for n in graph.graph.node if n.name == "head.scores")
        graph.graph.output.append(onnx.helper.make_tensor_value_info(tensor, onnx.TensorProto.FLOAT, None))
        feed = {"crop": pairs[1].search[None], "cls_kernel": kernels[0], "reg_kernel": kernels[1]}
        return open_session(graph.SerializeToString(), 1).run([tensor], feed)[0]

    template = open_session(template_graph(network.spec, layers(network), Ranges()).SerializeToString(), 1)
    kernels = [k / 4 for k in template.run(None, {"crop": pairs[1].template[None]})]
    expected = logits(Ranges(), kernels)
    # steps follow the kernels: at a quarter of their size only those of the maps are coarser against what they hold
    assert np.abs(logits(ranges, kernels) - expected).mean() < 0.05 * np.abs(expected).mean()
    # and a channel without any kernel gives nothing, not a division by zero
    assert np.isfinite(logits(ranges, [np.zeros_like(k) for k in kernels])).all()


def test_uneven_widths_are_filled_up_with_filters_of_zeros(network: SiamFCpp) -> None:
    filled = layers(network)
    assert set(READERS) <= set(filled) and any(width % 4 for width in network.spec.widths.values())
    for name, after in READERS.items():
        width, own = network.spec.widths[name], filled[name]
        assert len(own.bias) == -(-width // 4) * 4
        assert not own.weight[width:].any() and not own.bias[width:].any()
        assert all(filled[reader].weight.shape[1] == len(own.bias) for reader in after)


def test_dividing_channels_changes_nothing_that_comes_out(network: SiamFCpp, pairs: list[Pair]) -> None:
    rng = np.random.default_rng(0)
    factors = {name: rng.uniform(0.2, 5, len(layers(network)[name].bias)).astype(np.float32) for name in READERS}
    expected, found = (answer(network, Ranges(factors=some), pairs[0]) for some in ({}, factors))
    assert_allclose(found[0], expected[0], atol=2e-3)  # weights are stored in half precision
    assert_allclose(found[1], expected[1], rtol=0.02, atol=0.5)
    plain, changed = layers(network), divided(layers(network), factors, network.spec.arch.readers)
    assert all((changed[name].gain != plain[name].gain).all() for name in READERS)


def test_channels_and_the_weights_that_read_them_are_brought_nearer_to_each_other(network: SiamFCpp) -> None:
    from psiamfcpp.export.quantize import _factors

    peaks = np.geomspace(1, 100, 8).astype(np.float32)
    weight = np.ones((3, 8, 1, 1), np.float32)
    reader = {
        "reader": dataclasses.replace(layers(network)["backbone.conv2"], weight=weight, gain=np.ones(3, np.float32))
    }
    # even weights: channels meet half-way, on the logarithm
    assert_allclose(peaks / _factors(peaks, reader, ["reader"]), np.sqrt(peaks), rtol=1e-5)
    # a dead channel does not make its weights endless
    assert _factors(np.append(peaks[:7], 0).astype(np.float32), reader, ["reader"])[7] > 0


@pytest.mark.slow
def test_each_layer_is_judged_alone(network: SiamFCpp, ranges: Ranges, pairs: list[Pair]) -> None:
    by_layer = dict(losses(network.spec, layers(network), ranges, pairs[:1]))
    assert set(by_layer) == set(ranges.inputs)
    # the regression branch cannot move a score, nor the classification branch a corner
    assert by_layer["head.reg2"].scores == 0
    assert by_layer["head.cls2"].boxes == 0
    assert by_layer["backbone.conv1"].scores > 0


def test_ranges_hold_the_highest_value_of_every_crop(network: SiamFCpp, pairs: list[Pair]) -> None:
    first, second, both = (measure(network.spec, layers(network), some) for some in (pairs[:1], pairs[1:2], pairs[:2]))
    for one in ("features", "maps"):
        assert_array_equal(getattr(both, one), np.maximum(getattr(first, one), getattr(second, one)))
    # what enters the head is not divided by anything
    low, high = both.inputs["head.cls1"]
    assert low == min(first.inputs["head.cls1"][0], second.inputs["head.cls1"][0])
    assert high == max(first.inputs["head.cls1"][1], second.inputs["head.cls1"][1])


def test_pixels_are_taken_as_they_are(ranges: Ranges) -> None:
    assert ranges.inputs["backbone.conv1"] == (0.0, 255.0)


def test_samples_are_the_same_each_time_and_come_from_every_source(blob_sequence) -> None:
    from psiamfcpp import datasets

    root = blob_sequence("alpha", [(100, 80, 40, 30)] * 3)
    blob_sequence("beta", [(100, 80, 40, 30)] * 3)
    sequences = datasets.read("folder", root)
    first, again = (sample(sequences, ModelSpec(), 4, seed=5) for _ in range(2))
    for a, b in zip(first, again, strict=True):
        assert_array_equal(a.template, b.template)
        assert_array_equal(a.search, b.search)
    assert [p.template.shape for p in first] == [(127, 127, 3)] * 4
    # the target is in the middle of every template and somewhere in every search crop
    assert all(p.template[63, 63].min() > 200 and p.search.max() > 200 for p in first)


@pytest.mark.slow
def test_without_data_targets_of_rendered_clips_are_shown() -> None:
    (pair,) = rendered(ModelSpec(search_size=191), 1)
    assert (pair.template.shape, pair.search.shape) == ((127, 127, 3), (191, 191, 3))
    # the car in the middle of the template has more colour than the ground at its rim
    colour = np.ptp(pair.template.astype(int), axis=2)
    assert colour[54:73, 54:73].mean() > 2 * np.median(colour)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("weights", [0.0, 1e-9, 1e-30, -1e-9])
@pytest.mark.parametrize("value", [5.0, -700.0, 1e-20])
def test_dead_and_decayed_filters_keep_their_bias_in_eight_bits(
    network: SiamFCpp, ranges: Ranges, weights: float, value: float
) -> None:
    found = layers(network)
    name, filter_ = "head.reg2", 1
    changed = dataclasses.replace(found[name], weight=found[name].weight.copy(), bias=found[name].bias.copy())
    changed.weight[filter_], changed.bias[filter_] = weights, value
    alone = dataclasses.replace(without(ranges, set(ranges.inputs) - {name}), factors={})
    graph = search_graph(network.spec, {**found, name: changed}, alone).graph
    stored = {t.name: onnx.numpy_helper.to_array(t) for t in graph.initializer}
    bias = stored[f"{name}.bias"] * stored[f"{name}.bias_scale"].astype(np.float64)
    # All biases, of ordinary filters as well, are within half of their step.
    assert (np.abs(bias - changed.bias) <= 0.51 * stored[f"{name}.bias_scale"] + 1e-7 * np.abs(changed.bias)).all()
    assert bias[filter_] == pytest.approx(value, rel=1e-6, abs=1e-12)
