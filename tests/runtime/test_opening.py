"""The table of engines: it is true of the classes, and what follows from it is what a user reads."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from psiamfcpp import UserError
from psiamfcpp.runtime import ENGINES, open_engine, runs
from psiamfcpp.runtime.opening import KINDS, forms


@pytest.mark.parametrize("name", ENGINES)
def test_the_table_names_a_class_of_that_name(name: str) -> None:
    kind = KINDS[name]
    pytest.importorskip({"onnx": "onnxruntime"}.get(name, name))
    assert getattr(importlib.import_module(kind.module), kind.class_name).name == name
    assert bool(kind.suffixes) == (kind.form == "graphs")


@pytest.mark.parametrize(
    ("form", "expected"),
    [
        ("checkpoint", {"onnx": False, "openvino": False, "torch": True}),
        ("onnx", {"onnx": True, "openvino": True, "torch": False}),
        ("xml", {"onnx": False, "openvino": True, "torch": False}),
        ("half of it", {"onnx": False, "openvino": False, "torch": False}),
    ],
)
def test_an_engine_runs_what_it_can_read(tmp_path: Path, form: str, expected: dict[str, bool]) -> None:
    files = {
        "checkpoint": [],
        "onnx": ["template.onnx", "search.onnx"],
        "xml": ["template.xml", "search.xml"],
        "half of it": ["search.onnx"],
    }
    for file in files[form]:
        (tmp_path / file).touch()
    model = tmp_path / "model.safetensors" if form == "checkpoint" else tmp_path
    assert {name: runs(name, str(model)) for name in ENGINES} == expected


def test_a_shipped_name_runs_in_each_form_that_is_shipped() -> None:
    assert {name: runs(name, "psiamfcpp-alexnet") for name in ENGINES} == dict.fromkeys(ENGINES, True)
    assert not runs("torch", "psiamfcpp-alexnet-int8")


@pytest.mark.parametrize(("model", "precision"), [("psiamfcpp-alexnet", "fp32"), ("psiamfcpp-alexnet-n-int8", "int8")])
def test_the_precision_is_that_of_the_graph(model: str, precision: str) -> None:
    assert open_engine(model, "onnx", 1, 239).precision == precision


def test_what_runs_what_is_said_in_a_sentence() -> None:
    assert forms() == "graphs run on onnx and openvino, checkpoints run on torch"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"device": "gpu"}, "unknown device 'gpu'"),
        ({"device": "cuda", "engine": "openvino"}, "the openvino engine does not compute on cuda: .* onnx or torch$"),
        ({"device": "tensorrt", "engine": "torch"}, "the torch engine does not compute on tensorrt: .*engine onnx$"),
        # the form's default engine
        ({"device": "tensorrt"}, "the torch engine does not compute on tensorrt"),
        ({"device": "cuda", "engine": "onnx"}, "the onnx engine runs graphs, and this is a checkpoint"),
    ],
)
def test_a_device_that_cannot_be_used_is_refused(tiny_model: Path, options: dict[str, str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        open_engine(str(tiny_model), **options)  # type: ignore[arg-type]


def test_the_torch_engine_sends_graphs_elsewhere(tiny_graphs: Path) -> None:
    with pytest.raises(UserError, match=r"the torch engine runs checkpoints, .*: choose the engine onnx or openvino$"):
        open_engine(str(tiny_graphs), "torch")
