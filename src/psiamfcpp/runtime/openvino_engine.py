"""The OpenVINO engine: runs exported graphs, as ONNX or in OpenVINO's own form."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import openvino

from psiamfcpp.geometry import Image
from psiamfcpp.runtime.device import Device
from psiamfcpp.runtime.engine import Float32Array
from psiamfcpp.runtime.graph_engine import GraphEngine, Kernels, Template
from psiamfcpp.runtime.graph_file import damaged, read_spec
from psiamfcpp.runtime.lanes import Search
from psiamfcpp.spec import ModelSpec


class OpenVinoEngine(GraphEngine):
    """See `psiamfcpp.runtime.engine.Engine`."""

    name = "openvino"

    def _open_template(self, path: Path, threads: int, device: Device) -> tuple[Template, ModelSpec]:
        model, spec = _read(path)
        (request,) = _compile(path, model, threads, 1)
        return functools.partial(_template, request), spec

    def _open_search(
        self, path: Path, search_size: int, threads: int, lanes: int, device: Device
    ) -> tuple[list[Search], ModelSpec]:
        model, spec = _read(path)
        model.reshape({"crop": [1, search_size, search_size, 3]})
        names = [given.get_any_name() for given in model.inputs]
        return [functools.partial(_search, lane, names) for lane in _compile(path, model, threads, lanes)], spec


@functools.cache
def core() -> openvino.Core:
    """Return the process's one OpenVINO runtime.

    Each runtime sets the thread's alternate signal stack and puts back the one before when it goes. Where two go in
    the order in which they came, the second puts back a stack that is no more, and the next signal kills the process.
    """
    return openvino.Core()


def _read(path: Path) -> tuple[Any, ModelSpec]:
    try:
        model = core().read_model(path)
    except RuntimeError as error:
        # the reason stands at the end of a chain of source lines
        raise damaged(path, RuntimeError(str(error).strip().splitlines()[-1])) from None
    paths = {key: ["framework", key] for key in ("format", "spec")}
    return model, read_spec(
        {k: str(model.get_rt_info(p).value) for k, p in paths.items() if model.has_rt_info(p)}, path
    )


def _compile(path: Path, model: Any, threads: int, lanes: int) -> list[Any]:
    """Return requests that may run at once, one per lane, each on threads of its own."""
    # Left to itself OpenVINO computes float layers in bfloat16 where the processor can.
    config = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": threads * lanes, "NUM_STREAMS": lanes}
    try:
        compiled = core().compile_model(model, "CPU", config)
        return [compiled.create_infer_request() for _ in range(lanes)]
    except RuntimeError as error:
        raise damaged(path, RuntimeError(str(error).strip().splitlines()[-1])) from None


def _template(request: Any, crop: Image) -> Kernels:
    found = request.infer({"crop": crop[None]}, share_inputs=True)
    return tuple(kernel.copy() for kernel in found.values())


def _search(request: Any, names: list[str], crop: Image, kernels: Kernels) -> tuple[Float32Array, Float32Array]:
    # The crop is the first input, and the kernels follow as the template graph gives them.
    feed = dict(zip(names, (crop[None], *kernels), strict=True))
    found = request.infer(feed, share_inputs=True)
    return found["scores"][0], found["boxes"][0]
