"""The onnxruntime engine: runs exported graphs, the default."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import onnxruntime

from psiamfcpp.geometry import Image
from psiamfcpp.runtime.engine import Float32Array, Images, usable_cores
from psiamfcpp.runtime.graph_file import damaged, graph_files, read_spec, same_model
from psiamfcpp.runtime.lanes import Lanes, Search

Kernels = tuple[Float32Array, Float32Array]


class OnnxEngine:
    """See `psiamfcpp.runtime.engine.Engine`."""

    def __init__(self, folder: Path, threads: int | None = None, search_size: int | None = None):
        template, search = graph_files(folder, (".onnx",))
        self._template = _open(template, threads)
        described = read_spec(self._template.get_modelmeta().custom_metadata_map, template)
        size = described.search_size if search_size is None else search_size
        self.spec = dataclasses.replace(described, search_size=size)
        self._search = _open(search, threads, size)
        same_model(template, described, search, read_spec(self._search.get_modelmeta().custom_metadata_map, search))

        def open_lanes(count: int) -> list[Search]:
            # a session may run in many threads at once
            return [partial(_search, _open(search, total // count, size))] * count

        total = threads or usable_cores()
        self._lanes = Lanes(total, self.search, open_lanes)
        self._warm_up()

    def template(self, crop: Image) -> Kernels:
        """Correlation kernels of a template crop ``(127, 127, 3)``, uint8, BGR."""
        cls, reg = self._template.run(("cls_kernel", "reg_kernel"), {"crop": crop[None]})
        return cls, reg

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


def _search(session: onnxruntime.InferenceSession, crop: Image, kernels: Kernels) -> tuple[Float32Array, Float32Array]:
    feed = {"crop": crop[None], "cls_kernel": kernels[0], "reg_kernel": kernels[1]}
    scores, boxes = session.run(("scores", "boxes"), feed)
    return scores[0], boxes[0]


def open_session(
    graph: str | bytes, threads: int | None, search_size: int | None = None
) -> onnxruntime.InferenceSession:
    """A session on a graph file or its bytes, made for search crops of that size."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    # By itself onnxruntime counts the machine's cores, not those that this process may use, and its threads would
    # wait for each other in busy loops.
    options.intra_op_num_threads = threads or usable_cores()
    # Between two searches its threads would go on in busy loops, and decoding, drawing and other sessions wait.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    # Threads take smaller and smaller blocks of a layer, so that none waits long for the last.
    options.add_session_config_entry("session.dynamic_block_base", "4")
    if search_size is not None:
        # With its size known at load, onnxruntime lays out memory and folds the grid of cells once.
        options.add_free_dimension_override_by_name("size", search_size)
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])


def _open(path: Path, threads: int | None, search_size: int | None = None) -> onnxruntime.InferenceSession:
    try:
        return open_session(str(path), threads, search_size)
    except Exception as error:  # onnxruntime's errors have no common base of their own
        raise damaged(path, error) from None
