"""Time several crops in the 8-bit search graph: one after the other, as one batch, and side by side.

    python benchmarks/batch.py --threads 2 [--targets 4] [--rounds 20]

Prints the time of all crops for each way. The batch is a copy of the graph whose correlation has the groups of all
targets. Needs the extra `train` (onnx).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import tyro
from onnx import helper, numpy_helper

from psiamfcpp.runtime import open_engine
from psiamfcpp.runtime.graph_file import graph_files
from psiamfcpp.runtime.onnx_engine import open_session
from psiamfcpp.zoo import DEFAULT_MODEL, graph_folder


def main(model: str = DEFAULT_MODEL, threads: int = 1, targets: int = 4, rounds: int = 20) -> None:
    """Measure and print.

    Args:
        model: name of a shipped model in 8 bits, or a folder that `psiamfcpp export --int8` wrote.
        threads: threads of the engine.
        targets: crops, each with kernels of its own.
        rounds: how often each way is measured.
    """
    engine = open_engine(model, "onnx", threads)
    spec, rng = engine.spec, np.random.default_rng(0)
    crops = rng.integers(0, 256, (targets, spec.search_size, spec.search_size, 3), dtype=np.uint8)
    kernels = [
        engine.template(np.ascontiguousarray(crop[: spec.template_size, : spec.template_size])) for crop in crops
    ]
    session = open_session(batched(model, targets, spec.arch.score_size(spec.search_size)), threads, spec.search_size)
    feed = {
        "crop": crops,
        **{f"{b}_kernel": np.concatenate([k[i] for k in kernels]) for i, b in enumerate(("cls", "reg"))},
    }
    ways: dict[str, Callable[[], Any]] = {
        "one after the other": lambda: [engine.search(c, k) for c, k in zip(crops, kernels, strict=True)],
        "one batch": lambda: session.run(("scores", "boxes"), feed),
        "side by side": lambda: engine.search_many(crops, kernels),
    }
    assert np.array_equal(ways["one batch"]()[0], ways["side by side"]()[0])
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, search in ways.items():
            start = time.perf_counter()
            search()
            taken[name].append(1000 * (time.perf_counter() - start))
    for name, values in taken.items():
        print(f"{name:20} {np.median(values):7.1f} ms, at best {min(values):.1f}")


def batched(model: str, count: int, cells: int) -> bytes:
    """Return the search graph for a batch of that many crops, with a score map of that side.

    The features of all stand side by side in one grouped convolution.
    """
    folder = graph_folder(model)
    assert folder is not None
    _, path = graph_files(folder, (".onnx",))
    graph = onnx.load(path)
    nodes, constants = graph.graph.node, {c.name: c for c in graph.graph.initializer}
    for value in [*graph.graph.input, *graph.graph.output]:
        value.type.tensor_type.shape.dim[0].dim_value = count
    place, conv = next((i, node) for i, node in enumerate(nodes) if node.name == "correlation")
    (group,) = (a for a in conv.attribute if a.name == "group")
    # sides of the maps before and after the correlation: three more cells, then three layers of three
    before, after = cells + 9, cells + 6
    shapes = {"together": [1, count * group.i, before, before], "apart": [count, group.i, after, after]}
    for name, shape in shapes.items():
        graph.graph.initializer.append(numpy_helper.from_array(np.array(shape), name))
    nodes.insert(place, helper.make_node("Reshape", [conv.input[0], "together"], ["all_features"]))
    nodes.insert(place + 2, helper.make_node("Reshape", ["all_maps", "apart"], ["correlation"]))
    group.i *= count
    conv.input[0], conv.output[0] = "all_features", "all_maps"
    peaks = np.tile(numpy_helper.to_array(constants["peaks"]), (count, 1, 1, 1))
    constants["peaks"].CopyFrom(numpy_helper.from_array(peaks, "peaks"))
    return bytes(graph.SerializeToString())


if __name__ == "__main__":
    tyro.cli(main)
