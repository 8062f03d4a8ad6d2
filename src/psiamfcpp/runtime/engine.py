"""The calls behind which every engine runs a model: numpy in, numpy out."""

from __future__ import annotations

import os
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.spec import ModelSpec
from psiamfcpp.zoo import DEFAULT_MODEL, graph_folder, names, weights_path

Float32Array = NDArray[np.float32]
Images = NDArray[np.uint8]

ENGINES = ("onnx", "openvino", "torch")


class Engine(Protocol):
    """A loaded model."""

    spec: ModelSpec
    """its description; ``spec.search_size`` is the size that `search` takes"""

    def template(self, crop: Image) -> Any:
        """Correlation kernels of a template crop ``(127, 127, 3)``, uint8, BGR; only this engine can read them."""
        ...

    def search(self, crop: Image, kernels: Any) -> tuple[Float32Array, Float32Array]:
        """Scores ``(N, N)`` and boxes ``(N, N, 4)``, x0, y0, x1, y1 in the crop, of a crop ``(S, S, 3)`` uint8 BGR."""
        ...

    def search_many(self, crops: Images, kernels: list[Any]) -> tuple[Float32Array, Float32Array]:
        """Scores ``(B, N, N)`` and boxes ``(B, N, N, 4)`` of crops ``(B, S, S, 3)``, each with kernels of its own."""
        ...


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def open_engine(
    model: str = DEFAULT_MODEL,
    engine: str | None = None,
    threads: int | None = None,
    search_size: int | None = None,
) -> Engine:
    """Load a model into an engine and warm it up.

    Args:
        model: name of a shipped model, a checkpoint, or a folder that `psiamfcpp export` wrote.
        engine: one of `ENGINES`; by default onnx for exported graphs and torch for a checkpoint.
        threads: threads that the engine may use; by default as many as there are cores.
        search_size: side of the search crop in pixels; by default the model's own.

    Raises:
        UserError: unknown model, engine or size, an engine that is not installed, or one that cannot run this model.
    """
    if engine not in (None, *ENGINES):
        raise UserError(f"unknown engine {engine!r}: known are {', '.join(ENGINES)}")
    if threads is not None and threads < 1:
        raise UserError(f"threads is {threads}: it must be at least 1")
    graphs = graph_folder(model)
    if engine == "torch" or (engine is None and graphs is None):
        if graphs is not None and model not in names():
            raise UserError(f"the torch engine runs checkpoints, and {model} holds graphs: choose another engine")
        weights_path(model)
        try:
            from psiamfcpp.runtime.torch_engine import TorchEngine
        except ModuleNotFoundError as error:
            raise UserError(f"the torch engine needs {error.name}: pip install 'psiamfcpp[train]'") from None
        return TorchEngine(model, threads, search_size)
    if graphs is None:
        weights_path(model)
        mend = f"`psiamfcpp export {model} -o DIR`, then use DIR as the model"
        raise UserError(f"the {engine} engine runs graphs, and this is a checkpoint: {mend}")
    if engine == "openvino":
        try:
            from psiamfcpp.runtime.openvino_engine import OpenVinoEngine
        except ModuleNotFoundError as error:
            raise UserError(f"the openvino engine needs {error.name}: pip install 'psiamfcpp[openvino]'") from None
        return OpenVinoEngine(graphs, threads, search_size)
    from psiamfcpp.runtime.onnx_engine import OnnxEngine

    return OnnxEngine(graphs, threads, search_size)
