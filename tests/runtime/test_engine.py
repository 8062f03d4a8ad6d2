"""Engines: what cannot be opened says why, and the torch engine is the network itself."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from psiamfcpp import Tracker, UserError, zoo
from psiamfcpp.demo.clip import DemoFrame
from psiamfcpp.geometry import Image
from psiamfcpp.models import load
from psiamfcpp.runtime import ENGINES, Engine, open_engine
from psiamfcpp.spec import ModelSpec


@pytest.fixture(autouse=True)
def threads_as_before() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def noise(side: int) -> Image:
    return np.random.default_rng(side).integers(0, 256, (side, side, 3), dtype=np.uint8)


def as_input(crop: Image) -> torch.Tensor:
    return torch.tensor(crop.transpose(2, 0, 1)[None].astype(np.float32))


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    if request.param != "torch":
        pytest.importorskip({"onnx": "onnxruntime"}.get(request.param, request.param))
    return str(request.param)


@pytest.fixture
def runnable(engine: str, tiny_model: Path, tiny_graphs: Path) -> str:
    """The tiny model in the form that the engine runs."""
    return str(tiny_model if engine == "torch" else tiny_graphs)


@pytest.mark.parametrize(("search_size", "cells"), [(None, 17), (239, 9)])
def test_an_engine_is_the_network(
    tiny_model: Path, runnable: str, engine: str, search_size: int | None, cells: int
) -> None:
    opened = open_engine(runnable, engine, 1, search_size)
    side = opened.spec.search_size
    assert side == (search_size or 303)
    z, x = noise(127), noise(side)
    scores, boxes = opened.search(x, opened.template(z))
    assert (scores.shape, boxes.shape) == ((cells, cells), (cells, cells, 4))
    assert scores.dtype == boxes.dtype == np.float32
    network = load(tiny_model)
    with torch.no_grad():
        expected_scores, expected_boxes = network.search(as_input(x), network.template(as_input(z)))
    assert_allclose(scores, expected_scores[0], atol=1e-4)
    assert_allclose(boxes, expected_boxes[0], rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_all_engines_follow_a_clip_alike(
    engine: str, runnable: str, tiny_model: Path, rendered_clip: list[DemoFrame]
) -> None:
    def boxes(model: str, name: str) -> np.ndarray:
        tracker = Tracker(model, name, threads=1, plain=True)
        tracker.init(rendered_clip[0].image, rendered_clip[0].box)
        return np.array([tracker.update(shot.image).box for shot in rendered_clip[1:]])

    # the tolerance that docs/export.md states, in pixels of the frame
    assert_allclose(boxes(runnable, engine), boxes(str(tiny_model), "torch"), atol=0.1)


@pytest.mark.parametrize("threads", [1, 2])
def test_many_crops_are_each_searched_with_their_own_kernels(engine: str, runnable: str, threads: int) -> None:
    opened = open_engine(runnable, engine, threads)
    crops = np.stack([noise(303), 255 - noise(303), noise(303) // 2])
    kernels = [opened.template(crop[:127, :127].copy()) for crop in crops]
    scores, boxes = opened.search_many(crops, kernels)
    for i in range(3):
        expected = opened.search(crops[i], kernels[i])
        assert_allclose(scores[i], expected[0], atol=1e-5)
        assert_allclose(boxes[i], expected[1], rtol=1e-4, atol=1e-4)


def test_without_a_name_graphs_run_in_onnxruntime_and_checkpoints_in_torch(tiny_model: Path, tiny_graphs: Path) -> None:
    assert open_engine(str(tiny_graphs), threads=1).name == "onnx"
    assert open_engine(str(tiny_model), threads=1).name == "torch"


def test_an_engine_says_what_it_is(engine: str, runnable: str) -> None:
    opened = open_engine(runnable, engine, 1)
    assert isinstance(opened, Engine)
    assert (opened.name, opened.device, opened.precision) == (engine, "cpu", "fp32")


MEMBERS = {"name": "mine", "device": "cpu", "precision": "fp32", "spec": ModelSpec()}
MEMBERS |= dict.fromkeys(("template", "search", "search_many"), lambda self, crop, kernels=None: None)


@pytest.mark.parametrize("lacking", [None, *MEMBERS])
def test_any_object_with_the_members_is_an_engine(lacking: str | None) -> None:
    own = type("Own", (), {name: value for name, value in MEMBERS.items() if name != lacking})()
    assert isinstance(own, Engine) is (lacking is None)


def test_kernels_outlive_the_buffer_of_their_crop(engine: str, runnable: str) -> None:
    opened = open_engine(runnable, engine, threads=1)
    z, x = noise(127), noise(303)
    kernels = opened.template(z)
    before, _ = opened.search(x, kernels)
    kept = before.copy()
    z[:] = 0
    after, _ = opened.search(x, kernels)
    assert_allclose(after, kept, atol=1e-6)
    opened.search(noise(303) // 2, kernels)
    assert_allclose(after, kept, atol=1e-6)  # nor does a later search overwrite an earlier result


def test_threads_are_set(tiny_model: Path) -> None:
    open_engine(str(tiny_model), "torch", threads=2)
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"engine": "tensorflow"}, r"unknown engine 'tensorflow': known are .*torch"),
        ({"engine": ""}, "unknown engine ''"),
        ({"threads": 0}, "threads is 0: it must be from 1 to 1024"),
        ({"threads": -3}, "threads is -3"),
        ({"search_size": 300}, "search size 300 is not 127 plus a multiple of 8: try 239 or 303"),
        ({"search_size": 127}, "search size 127 leaves a score map"),
        ({"search_size": 0}, "search size 0"),
        ({"model": "no/such/model.safetensors"}, "'no/such/model.safetensors' is neither a file nor a shipped model"),
    ],
)
def test_what_cannot_be_opened_says_why(tiny_model: Path, options: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        open_engine(**{"model": str(tiny_model), **options})  # type: ignore[arg-type]


@pytest.mark.parametrize("engine", ["onnx", "openvino"])
def test_a_checkpoint_is_to_be_exported_first(tiny_model: Path, engine: str) -> None:
    with pytest.raises(UserError, match=rf"the {engine} engine runs graphs, .*`psiamfcpp export .*tiny.safetensors"):
        open_engine(str(tiny_model), engine)


@pytest.fixture(params=["onnx", "openvino"])
def graph_engine(request: pytest.FixtureRequest) -> str:
    pytest.importorskip({"onnx": "onnxruntime"}.get(request.param, request.param))
    return str(request.param)


@pytest.mark.parametrize("graph", ["template", "search"])
@pytest.mark.parametrize("share", [0.0, 0.4, 0.999])
def test_a_cut_graph_is_refused(graph_engine: str, tiny_graphs: Path, tmp_path: Path, graph: str, share: float) -> None:
    folder = shutil.copytree(tiny_graphs, tmp_path / "cut")
    path = folder / f"{graph}.onnx"
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(UserError, match=rf"graph .*{graph}\.onnx") as caught:
        open_engine(str(folder), graph_engine, 1)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("format_name", "message"),
    [("psiamfcpp-graph/0", "is psiamfcpp-graph/0, psiamfcpp-graph/1 is"), (None, "was not written by psiamfcpp")],
)
def test_a_graph_of_another_version_is_refused(
    graph_engine: str, tiny_graphs: Path, tmp_path: Path, format_name: str | None, message: str
) -> None:
    onnx = pytest.importorskip("onnx")
    folder = shutil.copytree(tiny_graphs, tmp_path / "old")
    model = onnx.load(folder / "search.onnx")
    del model.metadata_props[:]
    if format_name:
        onnx.helper.set_model_props(model, {"format": format_name})
    onnx.save(model, folder / "search.onnx")
    with pytest.raises(UserError, match=rf"search.onnx {message}.*export the model again"):
        open_engine(str(folder), graph_engine, 1)


def test_both_graphs_must_be_of_one_model(graph_engine: str, tiny_graphs: Path, tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    folder = shutil.copytree(tiny_graphs, tmp_path / "mixed")
    model = onnx.load(folder / "search.onnx")
    for entry in model.metadata_props:
        entry.value = entry.value.replace('"neck.cls": 8', '"neck.cls": 9')
    onnx.save(model, folder / "search.onnx")
    with pytest.raises(UserError, match=r"template.onnx and .*search.onnx are of different models"):
        open_engine(str(folder), graph_engine, 1)


def test_a_folder_without_both_graphs_is_refused(graph_engine: str, tiny_graphs: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is neither a file nor a shipped model"):
        open_engine(str(tmp_path), graph_engine)
    shutil.copy(tiny_graphs / "search.onnx", tmp_path)
    with pytest.raises(UserError, match=r"does not hold .*template\.onnx and search\.onnx"):
        open_engine(str(tmp_path), graph_engine)


def test_without_openvino_the_install_line_is_given(tiny_graphs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "psiamfcpp.runtime.openvino_engine", raising=False)
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(UserError, match=r"openvino.*pip install 'psiamfcpp\[openvino\]'"):
        open_engine(str(tiny_graphs), "openvino")


def test_an_unknown_model_names_the_nearest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "siamfcpp-alexnet.safetensors").touch()
    monkeypatch.setattr(zoo, "_FOLDER", tmp_path)
    with pytest.raises(UserError, match=r"model 'siamfcpp-alexnt' .* did you mean 'siamfcpp-alexnet'"):
        open_engine("siamfcpp-alexnt")


def test_without_onnxruntime_the_install_line_is_given(tiny_graphs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "psiamfcpp.runtime.onnx_engine", raising=False)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(UserError, match=r"the onnx engine needs onnxruntime: pip install 'onnxruntime'"):
        open_engine(str(tiny_graphs))


def test_without_torch_the_install_line_is_given(tiny_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "psiamfcpp.runtime.torch_engine", raising=False)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(UserError, match=r"torch.*pip install 'psiamfcpp\[train\]'"):
        open_engine(str(tiny_model), "torch")


@pytest.mark.slow
def test_a_signal_is_survived_after_several_openvino_engines(tiny_graphs: Path) -> None:
    pytest.importorskip("openvino")
    program = f"""
import gc, os, signal
from psiamfcpp.runtime import open_engine
first, second = (open_engine({str(tiny_graphs)!r}, "openvino", 1) for _ in range(2))
del first
gc.collect()
del second
gc.collect()
signal.signal(signal.SIGTERM, lambda *_: print("heard"))
os.kill(os.getpid(), signal.SIGTERM)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "heard\n"), done.stderr
