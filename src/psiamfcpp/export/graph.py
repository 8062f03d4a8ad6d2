"""The two graphs of a model, `template` and `search`, by the exporter that its architecture names.

An exporter is a module with ``layers(model)``, which gives what `psiamfcpp.export.layers.layers` describes, and with
``template_graph`` and ``search_graph`` as below. The inputs of the search graph are ``crop`` and all outputs of the
template graph, by name; its outputs are ``scores`` and ``boxes``. One whose graphs follow the table row by row, as
`psiamfcpp.export.rows` appends them, names in ``FLOAT`` the parts that 8 bits leave alone.
"""

from __future__ import annotations

from collections.abc import Mapping

import onnx

from psiamfcpp.export.builder import Ranges
from psiamfcpp.export.layers import Layer
from psiamfcpp.models.arch import opened
from psiamfcpp.spec import ModelSpec

__all__ = ["Ranges", "search_graph", "template_graph"]


def template_graph(spec: ModelSpec, layers: Mapping[str, Layer], ranges: Ranges) -> onnx.ModelProto:
    """Return the graph ``crop (1, Z, Z, 3) uint8 BGR -> kernels``, run once for a target.

    Args:
        spec: the model's; it goes into the metadata.
        layers: what `psiamfcpp.export.layers.layers` gives.
        ranges: of what is to be quantized.
    """
    graph: onnx.ModelProto = opened(spec.arch.exporter).template_graph(spec, layers, ranges)
    return graph


def search_graph(spec: ModelSpec, layers: Mapping[str, Layer], ranges: Ranges) -> onnx.ModelProto:
    """Return the graph ``crop (1, S, S, 3) uint8 BGR, kernels -> scores (1, N, N), boxes (1, N, N, 4)``.

    Boxes are x0, y0, x1, y1 in pixels of the crop. Arguments as for `template_graph`.
    """
    graph: onnx.ModelProto = opened(spec.arch.exporter).search_graph(spec, layers, ranges)
    return graph
