"""LightFC: its table, its network, and the import of its deployed graphs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from psiamfcpp.cli import main
from psiamfcpp.errors import UserError
from psiamfcpp.models import load
from psiamfcpp.models.cost import facts
from psiamfcpp.models.lightfc import LightFC, correlate_cells, to_boxes

pytest.importorskip("onnx")
import onnx
from onnx import numpy_helper

from psiamfcpp.models.lightfc_import import _run, import_lightfc, normalised

from .deployed import TABLE, random_lightfc, write_deployed


@pytest.fixture(scope="module")
def network() -> LightFC:
    return random_lightfc()


@pytest.fixture(scope="module")
def deployed(network: LightFC, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return write_deployed(network, tmp_path_factory.mktemp("deployed"))


def crops(side: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(256, (1, 3, side, side), generator=generator).float()


def test_its_cost_is_the_published_graphs(network: LightFC) -> None:
    found = facts(network.spec)
    # 919 M multiply-adds of the search pass; 3,155,626 values in the graph before the fusion's branches are folded.
    assert found["gmacs"] == pytest.approx(0.9187, abs=1e-4)
    assert found["parameters"] == 3_155_429


@pytest.mark.parametrize(
    ("layer", "side", "width"),
    [
        ("backbone.stem", 128, 32),
        ("backbone.expand1", 128, 96),
        ("backbone.depthwise1", 64, 96),
        ("backbone.sum12", 16, 96),
        ("fusion.correlation", 16, 64),
        ("fusion.correlation_mean", 1, 64),
        ("fusion.join", 16, 192),
        ("head.score1_gate", 16, 256),
        ("head.offset", 16, 2),
    ],
)
def test_sides_and_widths_of_the_search_pass(layer: str, side: int, width: int) -> None:
    assert (TABLE.side(layer, 256), TABLE.width(layer, TABLE.groups)) == (side, width)


def test_both_crops_go_through_the_backbone_alone() -> None:
    assert {row.part for row in TABLE.layers if len(TABLE.views[row.name]) == 2} == {"backbone"}
    assert {TABLE.views[row.name] for row in TABLE.layers if row.part != "backbone"} == {("search",)}


def test_cells_are_correlated_in_reading_order() -> None:
    features, kernels = torch.randn(2, 5, 3, 4), torch.randn(2, 5, 2, 2)
    found = correlate_cells(features, kernels)
    assert found.shape == (2, 4, 3, 4)
    for i, (row, column) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1)]):
        expected = (features * kernels[:, :, row, column, None, None]).sum(1)
        torch.testing.assert_close(found[:, i], expected)


def test_a_box_from_its_cell_size_and_offset() -> None:
    size, offset = torch.full((1, 2, 16, 16), 0.25), torch.zeros(1, 2, 16, 16)
    size[0, 1] = 0.125
    offset[0, 0, 3, 7], offset[0, 1, 3, 7] = 0.5, -0.25
    box = to_boxes(size, offset)[0, 3, 7]
    # centre (7.5, 2.75) cells of 16 pixels; corners are the first and the last pixel
    assert box.tolist() == [120 - 32, 44 - 16, 120 + 32 - 1, 44 + 16 - 1]
    # A smaller crop shows the target as large, so that a share is one of the crop that LightFC was trained with.
    assert to_boxes(size[..., :12, :12], offset[..., :12, :12])[0, 3, 7].tolist() == box.tolist()


@pytest.mark.slow
def test_a_batch_is_its_crops_one_by_one(network: LightFC) -> None:
    z, x = torch.cat([crops(128, 1), crops(128, 2)]), torch.cat([crops(256, 3), crops(256, 4)])
    with torch.inference_mode():
        scores, boxes = network(z, x)
        for i in range(2):
            alone = network(z[i : i + 1], x[i : i + 1])
            torch.testing.assert_close(scores[i : i + 1], alone[0], rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(boxes[i : i + 1], alone[1], rtol=1e-4, atol=1e-3)


def assert_equal_outputs(network: LightFC, template: Path, track: Path) -> None:
    z, x = crops(128, 5), crops(256, 6)
    (features,) = _run(template, {"image": normalised(z)})
    expected = _run(track, {"image": normalised(x), "z": features})
    with torch.inference_mode():
        found = network.maps(network.features(x), network.template(z))
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours.numpy(), theirs, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_graphs_are_read_by_their_structure(
    deployed: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "lightfc.safetensors"
    assert main(["import", *map(str, deployed), "-o", str(output)]) == 0
    assert "3,155,429 parameters" in capsys.readouterr().out
    found = load(output)
    assert isinstance(found, LightFC)
    assert found.spec.calibration is None and found.spec.provenance == {"imported_from": "t.onnx, s.onnx"}
    assert_equal_outputs(found, *deployed)


@pytest.mark.slow
def test_weights_that_were_read_are_the_networks(network: LightFC, deployed: tuple[Path, Path]) -> None:
    found = import_lightfc(*deployed)
    for name, value in network.state_dict().items():
        torch.testing.assert_close(found.state_dict()[name], value, rtol=1e-5, atol=1e-6, msg=name)


@pytest.mark.slow
def test_the_deployed_graphs_give_their_outputs(shared_data: Path) -> None:
    files = tuple(shared_data.parent / "weights" / "peers" / f"lightfc_{name}.onnx" for name in ("template", "track"))
    if not all(path.is_file() for path in files):
        pytest.skip(f"no graphs of LightFC in {files[0].parent}")
    assert_equal_outputs(import_lightfc(*files), *files)


def altered(path: Path, change: Any, folder: Path) -> Path:
    model = onnx.load(str(path))
    change(model.graph)
    onnx.save(model, str(folder / "altered.onnx"))
    return folder / "altered.onnx"


def _without_a_convolution(graph: Any) -> None:
    last = [node for node in graph.node if node.op_type == "Conv"][-1]
    last.op_type = "Identity"
    del last.input[1:], last.attribute[:]


def _stride(graph: Any) -> None:
    first = next(node for node in graph.node if node.op_type == "Conv")
    next(a for a in first.attribute if a.name == "strides").ints[:] = [1, 1]


def _no_bias(graph: Any) -> None:
    del next(node for node in graph.node if node.op_type == "Conv").input[2]


def _other_activation(graph: Any) -> None:
    next(node for node in graph.node if node.op_type == "Relu").op_type = "Softplus"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_without_a_convolution, "it ends before head.offset"),
        (_stride, r"backbone.stem is \(32, 3, 3, 3\) with stride and padding \(1, 1\)"),
        (_no_bias, "a convolution has no weight or no bias"),
        (_other_activation, "computes something else than LightFC: score by"),
    ],
)
def test_other_graphs_are_refused(deployed: tuple[Path, Path], tmp_path: Path, change: Any, said: str) -> None:
    with pytest.raises(UserError, match=said) as caught:
        import_lightfc(deployed[0], altered(deployed[1], change, tmp_path))
    assert "altered.onnx" in str(caught.value) and "\n" not in str(caught.value)


def _other_weights(graph: Any) -> None:
    name = next(node for node in graph.node if node.op_type == "Conv").input[1]
    stored = next(tensor for tensor in graph.initializer if tensor.name == name)
    stored.CopyFrom(numpy_helper.from_array(2 * numpy_helper.to_array(stored), name))


def test_files_in_the_wrong_order_or_of_two_networks_are_refused(deployed: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no graph of LightFC"):
        import_lightfc(*reversed(deployed))
    with pytest.raises(UserError, match="different backbones"):
        import_lightfc(altered(deployed[0], _other_weights, tmp_path), deployed[1])


@pytest.mark.parametrize("content", [None, b"", b"junk"])
def test_what_is_no_graph_is_refused(deployed: tuple[Path, Path], tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "junk.onnx"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=r"junk\.onnx"):
        import_lightfc(deployed[0], path)


def test_three_files_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["import", "a", "b", "c", "-o", str(tmp_path / "x.safetensors")]) == 2
    assert "3 files to import" in capsys.readouterr().err
