"""Graphs that are damaged, hostile or not of one model: one line, before memory is taken."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.runtime import graph_file, open_engine
from psiamfcpp.runtime.graph_file import check_onnx

onnx = pytest.importorskip("onnx")


@pytest.fixture
def graphs(tiny_graphs: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    return Path(shutil.copytree(tiny_graphs, tmp_path / "graphs"))


def _swap(folder: Path) -> None:
    (folder / "search.onnx").rename(folder / "other.onnx")
    (folder / "template.onnx").rename(folder / "search.onnx")
    (folder / "other.onnx").rename(folder / "template.onnx")


def _changed(change: Callable[[Any], None], names: tuple[str, ...] = ("search",)) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        for name in names:
            model = onnx.load(str(folder / f"{name}.onnx"))
            change(model)
            onnx.save(model, str(folder / f"{name}.onnx"))

    return apply


def _spec(old: str, new: str) -> Callable[[Path], None]:
    def change(model: Any) -> None:
        (entry,) = [entry for entry in model.metadata_props if entry.key == "spec"]
        assert old in entry.value
        entry.value = entry.value.replace(old, new)

    return _changed(change, ("template", "search"))


def _bomb(model: Any) -> None:
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.array([2**40]), "much"))
    model.graph.node.insert(0, onnx.helper.make_node("ConstantOfShape", ["much"], ["zeros"]))


def _within(model: Any) -> None:
    inner = onnx.helper.make_graph([], "inner", [], [])
    model.graph.node.append(onnx.helper.make_node("Identity", ["crop"], ["x"], body=inner))


def _nan(model: Any) -> None:
    for tensor in model.graph.initializer:
        if tensor.name.endswith("bias") and tensor.data_type == onnx.TensorProto.FLOAT:
            values = onnx.numpy_helper.to_array(tensor)
            tensor.CopyFrom(onnx.numpy_helper.from_array(np.full_like(values, np.nan), tensor.name))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_swap, r"(graphs|\.onnx) cannot be loaded"),
        (_spec('"template_size": 127', '"template_size": 95'), "template size is 95: siamfcpp-alexnet has 127"),
        (_spec('"search_size": 303', '"search_size": 8000127'), "search size 8000127 is too large"),
        (_spec('"provenance": {}', '"provenance": {"x": ' + "[" * 500 + "]" * 500 + "}"), "nested more than 64 deep"),
        (_changed(_bomb), "search.onnx holds 'ConstantOfShape', which no export writes"),
        (_changed(_within), "search.onnx holds 'a graph within a node', which no export writes"),
        (_changed(_nan), "values that are not finite"),
        (lambda folder: (folder / "search.onnx").write_bytes(b""), "search.onnx"),
        (lambda folder: (folder / "search.onnx").write_bytes(b"\xff" * 100), "search.onnx cannot be loaded"),
    ],
)
def test_one_line(graphs: Path, damage: Callable[[Path], None], message: str) -> None:
    damage(graphs)
    with pytest.raises(UserError, match=message) as caught:
        open_engine(str(graphs), threads=1)
    assert "\n" not in str(caught.value)


def test_what_export_writes_is_known(tiny_graphs: Path) -> None:
    for name in ("template", "search"):
        check_onnx(tiny_graphs / f"{name}.onnx")


def test_every_operator_of_the_exporters_is_known() -> None:
    folder = Path(graph_file.__file__).parents[1] / "export"
    written = {name for path in folder.glob("*.py") for name in re.findall(r"\.add\(\s*\"(\w+)\"", path.read_text())}
    assert len(written) > 20
    assert written <= graph_file._OPERATORS


@pytest.mark.parametrize("size", [1, 7, 100, 5000])
def test_a_graph_that_is_cut_off(graphs: Path, size: int) -> None:
    content = (graphs / "search.onnx").read_bytes()
    (graphs / "search.onnx").write_bytes(content[:size])
    with pytest.raises(UserError, match=r"search\.onnx cannot be loaded"):
        check_onnx(graphs / "search.onnx")
