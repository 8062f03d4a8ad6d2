"""The graphs of LightFC: what they compute, and that engines run them by the names that the graphs have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("torch")

from models.deployed import random_lightfc
from psiamfcpp.errors import UserError
from psiamfcpp.export.crops import rendered
from psiamfcpp.export.files import write_graphs
from psiamfcpp.export.graph import Ranges
from psiamfcpp.export.quantize import measure
from psiamfcpp.models.lightfc import LightFC
from psiamfcpp.runtime import open_engine
from psiamfcpp.runtime.torch_engine import TorchEngine


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


def test_what_is_not_there_yet_is_said(network: LightFC) -> None:
    with pytest.raises(UserError, match="architecture lightfc has no 8-bit graphs yet"):
        measure(network.spec, {}, [])
