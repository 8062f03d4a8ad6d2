"""Both graphs of a model as files, which appear only once they are known to do what the network does."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from onnx import ModelProto

from psiamfcpp.errors import UserError
from psiamfcpp.export.crops import Pair
from psiamfcpp.export.graph import Ranges, search_graph, template_graph
from psiamfcpp.export.layers import Layer, layers
from psiamfcpp.export.parity import Difference, compare, look
from psiamfcpp.models import Network
from psiamfcpp.runtime import open_engine
from psiamfcpp.runtime.torch_engine import TorchEngine
from psiamfcpp.spec import ModelSpec

Format = Literal["onnx", "openvino"]


def write_graphs(model: Network, folder: Path, form: Format, ranges: Ranges, pairs: list[Pair]) -> Difference:
    """Write the graphs of a model into a folder.

    Args:
        model: the network, in evaluation mode.
        folder: made if need be; graphs that are in it are replaced.
        form: onnx, or OpenVINO's own files.
        ranges: what is to be quantized.
        pairs: crops on which the written files are checked against the network.

    Returns:
        How far the graphs are from the network.

    Raises:
        UserError: they are too far from it, or the folder cannot be written to; then nothing was.
    """
    graphs = graphs_of(model.spec, layers(model), ranges)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f"{folder.name}.", suffix=".part", dir=folder.parent))
    except OSError as error:
        raise UserError(f"graphs cannot be written to {folder}: {error}") from None
    try:
        write_files(graphs, work, form)
        expected = look(TorchEngine(model), pairs)
        difference = compare(expected, look(open_engine(str(work), form), pairs))
        difference.check(bool(ranges.inputs))
        folder.mkdir(exist_ok=True)
        for path in work.iterdir():
            path.replace(folder / path.name)
    except OSError as error:
        raise UserError(f"graphs cannot be written to {folder}: {error}") from None
    finally:
        shutil.rmtree(work)
    return difference


def graphs_of(spec: ModelSpec, weights: Mapping[str, Layer], ranges: Ranges) -> dict[str, ModelProto]:
    """Return both graphs of a network by the names of their files; arguments as for `template_graph`."""
    return {
        "template": template_graph(spec, weights, ranges),
        "search": search_graph(spec, weights, ranges),
    }


def write_files(graphs: Mapping[str, ModelProto], folder: Path, form: Format) -> None:
    """Write graphs into a folder that is there, unchecked.

    Raises:
        UserError: OpenVINO is not installed, and its own form is wanted.
    """
    for name, graph in graphs.items():
        _write(graph.SerializeToString(), folder / name, form)


def _write(graph: bytes, path: Path, form: Format) -> None:
    if form == "onnx":
        path.with_suffix(".onnx").write_bytes(graph)
        return
    try:
        import openvino

        from psiamfcpp.runtime.openvino_engine import core
    except ModuleNotFoundError as error:
        raise UserError(f"OpenVINO's form needs {error.name}: pip install 'psiamfcpp[openvino]'") from None
    openvino.save_model(core().read_model(graph), path.with_suffix(".xml"), compress_to_fp16=False)
