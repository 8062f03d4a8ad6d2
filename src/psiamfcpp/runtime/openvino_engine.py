"""The OpenVINO engine: runs exported graphs, as ONNX or in OpenVINO's own form."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
import openvino

from psiamfcpp.geometry import Image
from psiamfcpp.runtime.engine import Float32Array, Images, usable_cores
from psiamfcpp.runtime.graph_file import damaged, graph_files, read_spec, same_model
from psiamfcpp.runtime.lanes import Lanes, Search
from psiamfcpp.spec import ModelSpec

Kernels = tuple[Float32Array, Float32Array]


class OpenVinoEngine:
    """See `psiamfcpp.runtime.engine.Engine`."""

    def __init__(self, folder: Path, threads: int | None = None, search_size: int | None = None):
        template, search = graph_files(folder, (".xml", ".onnx"))
        template_model, described = _read(template)
        search_model, other = _read(search)
        same_model(template, described, search, other)
        size = described.search_size if search_size is None else search_size
        self.spec = dataclasses.replace(described, search_size=size)
        search_model.reshape({"crop": [1, size, size, 3]})
        total = threads or usable_cores()
        (self._template,) = _compile(template, template_model, total)
        (self._search,) = _compile(search, search_model, total)

        def open_lanes(count: int) -> list[Search]:
            return [functools.partial(_search, lane) for lane in _compile(search, search_model, total, count)]

        self._lanes = Lanes(total, self.search, open_lanes)
        self._warm_up()

    def template(self, crop: Image) -> Kernels:
        """Correlation kernels of a template crop ``(127, 127, 3)``, uint8, BGR."""
        found = self._template.infer({"crop": crop[None]}, share_inputs=True)
        return found["cls_kernel"].copy(), found["reg_kernel"].copy()

    def search(self, crop: Image, kernels: Kernels) -> tuple[Float32Array, Float32Array]:
        """Scores ``(N, N)`` and boxes ``(N, N, 4)`` of a search crop ``(S, S, 3)``, uint8, BGR."""
        return _search(self._search, crop, kernels)

    def search_many(self, crops: Images, kernels: list[Kernels]) -> tuple[Float32Array, Float32Array]:
        """Scores ``(B, N, N)`` and boxes ``(B, N, N, 4)`` of crops ``(B, S, S, 3)``, uint8, BGR."""
        return self._lanes.search_many(crops, kernels)

    def _warm_up(self) -> None:
        """Run once, so that the first frame costs no more than later ones."""
        z, x = (np.zeros((s, s, 3), np.uint8) for s in (self.spec.template_size, self.spec.search_size))
        self.search(x, self.template(z))


@functools.cache
def core() -> openvino.Core:
    """The process's one OpenVINO runtime.

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


def _search(request: Any, crop: Image, kernels: Kernels) -> tuple[Float32Array, Float32Array]:
    feed = {"crop": crop[None], "cls_kernel": kernels[0], "reg_kernel": kernels[1]}
    found = request.infer(feed, share_inputs=True)
    return found["scores"][0], found["boxes"][0]


def _compile(path: Path, model: Any, threads: int, lanes: int = 1) -> list[Any]:
    """Requests that may run at once, as many as lanes, on threads of their own."""
    # Left to itself OpenVINO computes float layers in bfloat16 where the processor can.
    config = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": threads, "NUM_STREAMS": lanes}
    try:
        compiled = core().compile_model(model, "CPU", config)
        return [compiled.create_infer_request() for _ in range(lanes)]
    except RuntimeError as error:
        raise damaged(path, RuntimeError(str(error).strip().splitlines()[-1])) from None
