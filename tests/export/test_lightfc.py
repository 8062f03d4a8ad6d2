"""The graphs of LightFC: what they compute, and that engines run them by the names that the graphs have."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest

pytest.importorskip("onnx")
pytest.importorskip("torch")

import onnx

from models.deployed import TABLE, random_lightfc
from psiamfcpp import TargetPool, Tracker
from psiamfcpp.datasets import Sequence
from psiamfcpp.demo.clip import render
from psiamfcpp.export.crops import Pair, rendered, sample
from psiamfcpp.export.equalize import factors
from psiamfcpp.export.files import graphs_of, write_files, write_graphs
from psiamfcpp.export.graph import Ranges, search_graph, template_graph
from psiamfcpp.export.layers import layers
from psiamfcpp.export.quantize import losses, measure, without
from psiamfcpp.export.rows import tensor
from psiamfcpp.models.lightfc import MEAN, LightFC
from psiamfcpp.runtime import open_engine
from psiamfcpp.runtime.onnx_engine import open_session
from psiamfcpp.runtime.torch_engine import TorchEngine
from psiamfcpp.spec import Calibration
from psiamfcpp.trackers.contract import STATES


@pytest.fixture(scope="module")
def network() -> LightFC:
    return random_lightfc()


@pytest.fixture(scope="module")
def graphs(network: LightFC, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lightfc") / "graphs"
    # Floats are checked against torch while they are written.
    write_graphs(network, folder, "onnx", Ranges(), rendered(network.spec, 1))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["onnx", "openvino"])
def test_engines_run_the_graphs(network: LightFC, graphs: Path, engine: str) -> None:
    pytest.importorskip("onnxruntime" if engine == "onnx" else engine)
    opened, expected = open_engine(str(graphs), engine, threads=2), TorchEngine(network, threads=1)
    assert opened.spec == network.spec and opened.spec.calibration is None
    pairs = rendered(network.spec, 2)
    kernels = [opened.template(pair.template) for pair in pairs]
    scores, boxes = opened.search_many(np.stack([pair.search for pair in pairs]), kernels)
    assert (scores.shape, boxes.shape) == ((2, 16, 16), (2, 16, 16, 4))
    for i, pair in enumerate(pairs):
        s, b = expected.search(pair.search, expected.template(pair.template))
        np.testing.assert_allclose(scores[i], s, atol=1e-3)
        np.testing.assert_allclose(boxes[i], b, atol=0.05)


@pytest.mark.slow
def test_other_sizes_of_the_search_crop(network: LightFC, graphs: Path) -> None:
    opened, expected = open_engine(str(graphs), "onnx", 1, 192), TorchEngine(network, 1, 192)
    crop = rendered(opened.spec, 1)[0]
    found, wanted = (e.search(crop.search, e.template(crop.template)) for e in (opened, expected))
    assert found[0].shape == (12, 12)
    np.testing.assert_allclose(found[0], wanted[0], atol=1e-3)
    np.testing.assert_allclose(found[1], wanted[1], atol=0.05)


@pytest.fixture(scope="module")
def pairs(network: LightFC) -> list[Pair]:
    return rendered(network.spec, 2)


@pytest.fixture(scope="module")
def ranges(network: LightFC, pairs: list[Pair]) -> Ranges:
    return measure(network.spec, layers(network), pairs)


def run(network: LightFC, ranges: Ranges, pair: Pair, *tensors: str) -> list[np.ndarray]:
    """Scores and boxes of the search graph, or tensors of it."""
    template = open_session(template_graph(network.spec, layers(network), Ranges()).SerializeToString(), 1)
    graph = search_graph(network.spec, layers(network), ranges)
    graph.graph.output.extend(onnx.helper.make_tensor_value_info(t, onnx.TensorProto.FLOAT, None) for t in tensors)
    (kernel,) = template.run(None, {"crop": pair.template[None]})
    search = open_session(graph.SerializeToString(), 1, 256)
    return search.run(tensors or ("scores", "boxes"), {"crop": pair.search[None], "kernel": kernel})


def noise(found: np.ndarray, expected: np.ndarray) -> float:
    """Power of the error as a share of the signal's."""
    return float(((found - expected) ** 2).sum() / ((expected - expected.mean()) ** 2).sum())


@pytest.mark.slow
def test_eight_bits_are_near_to_the_network(network: LightFC, ranges: Ranges, pairs: list[Pair]) -> None:
    names = [
        tensor(TABLE[name]) for name in ("backbone.sum12", "fusion.join", "head.score", "head.size", "head.offset")
    ]
    for found, expected in zip(*(run(network, some, pairs[0], *names) for some in (ranges, Ranges())), strict=True):
        assert noise(found, expected) < 0.03


@pytest.mark.slow
def test_all_but_the_smallest_and_the_last_layers_are_integers(
    network: LightFC, ranges: Ranges, tmp_path: Path
) -> None:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.optimized_model_filepath = str(tmp_path / "optimized.onnx")
    graph = search_graph(network.spec, layers(network), ranges).SerializeToString()
    onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    nodes = onnx.load(tmp_path / "optimized.onnx").graph.node
    integer = {n.name.removesuffix("_nhwc").split("_token")[0] for n in nodes if n.op_type == "QLinearConv"}
    small = {name for name in layers(network) if name.endswith(("_squeeze", "_excite")) or name.startswith("fusion.")}
    assert integer == set(ranges.inputs) == set(layers(network)) - small - {"head.score", "head.size", "head.offset"}
    counts = Counter(node.op_type for node in nodes)
    # the sums of eight residual blocks, and a gate in each head
    assert (counts["QLinearAdd"], counts["QLinearMul"], counts["QLinearConcat"]) == (8, 3, 1)


@pytest.mark.slow
def test_integer_pixels_are_padded_with_the_mean_colour(network: LightFC, ranges: Ranges) -> None:
    flat = Pair(np.zeros((128, 128, 3), np.uint8), np.tile(np.rint(MEAN).astype(np.uint8), (256, 256, 1)))
    stem = without(ranges, set(ranges.inputs) - {"backbone.stem"})
    (found,) = run(network, stem, flat, "backbone.stem")
    # no border is seen
    np.testing.assert_allclose(found, np.broadcast_to(found[..., 64:65, 64:65], found.shape), atol=1e-5)


@pytest.mark.slow
def test_integer_pixels_give_what_float_ones_give(network: LightFC, ranges: Ranges, pairs: list[Pair]) -> None:
    stem = dataclasses.replace(without(ranges, set(ranges.inputs) - {"backbone.stem"}), factors={})
    found, expected = (run(network, some, pairs[0], "backbone.stem")[0] for some in (stem, Ranges()))
    assert noise(found, expected) < 1e-4


@pytest.mark.slow
def test_channels_between_depthwise_pairs_have_one_range(network: LightFC, ranges: Ranges, pairs: list[Pair]) -> None:
    blocks = [f"backbone.expand{i}" for i in range(1, 13)]
    assert set(ranges.factors) == {"backbone.stem", *blocks}
    name = tensor(TABLE["backbone.expand3"])
    plain, even = (
        np.max([run(network, some, pair, name)[0].max(axis=(0, 2, 3)) for pair in pairs], axis=0)
        for some in (Ranges(), Ranges(factors=ranges.factors))
    )
    live = plain > plain.max() / 16
    np.testing.assert_allclose(even[live], plain.max(), rtol=0.01)
    assert (even[~live] <= plain.max() * 1.01).all() and plain.min() < 0.5 * plain.max()
    # and nothing else changes
    plain, even = (run(network, some, pairs[0]) for some in (Ranges(), Ranges(factors=ranges.factors)))
    for found, expected in zip(even, plain, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.02)


def test_a_channel_that_was_silent_is_not_blown_up() -> None:
    peaks = {row.name: np.array([6.0, 3.0, 0.0], np.float32) for row in TABLE.layers}
    np.testing.assert_allclose(factors(TABLE, peaks)["backbone.stem"], [1, 0.5, 1 / 16])
    silent = {row.name: np.zeros(3, np.float32) for row in TABLE.layers}
    assert np.isfinite(factors(TABLE, silent)["backbone.stem"]).all()


@pytest.mark.slow
def test_each_layer_is_judged_alone(network: LightFC, ranges: Ranges, pairs: list[Pair]) -> None:
    some = without(ranges, set(ranges.inputs) - {"head.score2", "head.size2", "backbone.project3"})
    by_layer = dict(losses(network.spec, layers(network), some, pairs[:1]))
    assert set(by_layer) == set(some.inputs)
    # the head of scores cannot move a corner, nor that of sizes a score
    assert by_layer["head.score2"].boxes == 0 and by_layer["head.score2"].scores > 0
    assert by_layer["head.size2"].scores == 0 and by_layer["head.size2"].boxes > 0
    assert by_layer["backbone.project3"].scores > 0 and by_layer["backbone.project3"].boxes > 0


@pytest.mark.slow
def test_crops_are_those_of_the_procedure(network: LightFC, pairs: list[Pair], tmp_path: Path) -> None:
    assert (pairs[0].template.shape, pairs[0].search.shape) == ((128, 128, 3), (256, 256, 3))
    frame = tmp_path / "frame.png"
    cv2.imwrite(str(frame), np.full((200, 200, 3), 90, np.uint8))
    # at the frame's corner most of the crop is outside, which is black here and the mean colour in SiamFC++
    sequence = Sequence("corner", [frame] * 2, np.array([[0, 0, 20, 20]] * 2, float))
    (pair,) = sample([sequence], network.spec, 1)
    assert {*np.unique(pair.template)} >= {0, 90} and not pair.template[:30].any()


@pytest.mark.slow
def test_widths_as_pruning_leaves_them_are_filled_up(tmp_path: Path) -> None:
    widths = {group: 17 + number for number, group in enumerate(TABLE.groups)}
    pruned = random_lightfc(widths=widths)
    filled = layers(pruned)
    for row in TABLE.layers:
        if row.name in filled and row.group:
            own, width = filled[row.name], widths[row.group]
            assert len(own.bias) % 16 == 0 and not own.weight[width:].any() and not own.bias[width:].any()
    assert filled["backbone.depthwise1"].weight.shape[0] == filled["backbone.expand1"].weight.shape[0]
    # It fails unless the graphs are the network.
    write_graphs(pruned, tmp_path / "graphs", "onnx", Ranges(), rendered(pruned.spec, 1))


@pytest.mark.slow
def test_calibrated_graphs_in_eight_bits_follow_two_targets_with_states(
    network: LightFC, ranges: Ranges, tmp_path: Path
) -> None:
    spec = dataclasses.replace(network.spec, calibration=Calibration())
    write_files(graphs_of(spec, layers(network), ranges), tmp_path, "onnx")
    pool, alone = (opened(str(tmp_path), threads=1) for opened in (TargetPool, Tracker))
    frames = [shot.image for shot in render(0, 4, (640, 360))]
    boxes = (300, 150, 40, 30), (100, 80, 60, 60)
    for box in boxes:
        pool.add(frames[0], box)
    alone.init(frames[0], boxes[0])
    for frame in frames[1:]:
        tracks = pool.update(frame)
        assert tracks[1] == alone.update(frame)
        assert {track.state for track in tracks.values()} <= set(STATES)
        assert all(track.score is not None and 0 <= track.score <= 1 for track in tracks.values())
