"""Compare each layer of a model with what the processor reaches in a plain matrix product.

    python benchmarks/limit.py [MODEL] [--threads N] [--rounds 20]

The peaks are those of a plain matrix product of 512x512 by 512x512 in the same library, with a constant right side
as layers have: float32, and uint8 by int8. Times are the best of the rounds. Needs the extra `train` (onnx).
"""

import argparse
import json
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

from psiamfcpp.runtime import usable_cores
from psiamfcpp.runtime.graph_file import precision
from psiamfcpp.runtime.onnx_engine import open_session, session_options
from psiamfcpp.zoo import DEFAULT_MODEL, graph_folder

SIDE = 512


def peak(integers: bool, threads: int, rounds: int) -> float:
    """Return multiply-accumulates per second of a matrix product, the best of the rounds."""
    rng = np.random.default_rng(0)
    dtype, kind = (np.uint8, TensorProto.UINT8) if integers else (np.float32, TensorProto.FLOAT)
    right = rng.integers(-127, 127, (SIDE, SIDE)).astype(np.int8 if integers else np.float32)
    op, out = ("MatMulInteger", TensorProto.INT32) if integers else ("MatMul", TensorProto.FLOAT)
    graph = helper.make_graph(
        [helper.make_node(op, ["a", "b"], ["c"])],
        "product",
        [helper.make_tensor_value_info("a", kind, [SIDE, SIDE])],
        [helper.make_tensor_value_info("c", out, [SIDE, SIDE])],
        [numpy_helper.from_array(right, "b")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    session = open_session(model.SerializeToString(), threads)
    left = rng.integers(0, 255, (SIDE, SIDE)).astype(dtype)
    best = float("inf")
    for _ in range(rounds):
        start = time.perf_counter()
        session.run(None, {"a": left})
        best = min(best, time.perf_counter() - start)
    return SIDE**3 / best


def example(session: onnxruntime.InferenceSession, size: int) -> dict[str, np.ndarray]:
    """Return a search crop and kernels of noise."""
    rng = np.random.default_rng(0)
    feed = {"crop": rng.integers(0, 256, (1, size, size, 3), dtype=np.uint8)}
    for value in session.get_inputs()[1:]:
        feed[value.name] = rng.standard_normal(value.shape).astype(np.float32)
    return feed


def layer_macs(model: onnx.ModelProto, size: int) -> dict[str, int]:
    """Return multiply-accumulates of each convolution of the graph, with the zeros that fill up widths and kernels."""
    convolutions = [node for node in model.graph.node if node.op_type == "Conv"]
    wanted = [name for node in convolutions for name in (node.output[0], node.input[1])]
    looked_into = onnx.ModelProto.FromString(model.SerializeToString())
    looked_into.graph.output.extend(helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in wanted)
    # What is fused has no output of its own, so nothing is.
    options = session_options(1, size)
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = onnxruntime.InferenceSession(looked_into.SerializeToString(), options, providers=["CPUExecutionProvider"])
    shapes = [array.shape for array in session.run(wanted, example(session, size))]
    return {
        node.name: int(np.prod(out) * np.prod(weight[1:]))
        for node, out, weight in zip(convolutions, shapes[::2], shapes[1::2], strict=True)
    }


def layer_times(path: Path, size: int, threads: int, rounds: int) -> dict[str, float]:
    """Return seconds of each node, the best of the rounds."""
    options = session_options(threads, size)
    options.enable_profiling = True
    with tempfile.TemporaryDirectory() as folder:
        options.profile_file_prefix = f"{folder}/profile"
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        feed = example(session, size)
        for _ in range(rounds):
            session.run(None, feed)
        events = json.loads(Path(session.end_profiling()).read_text())
    times = defaultdict(list)
    for event in events:
        if event.get("cat") == "Node" and event["name"].endswith("_kernel_time"):
            times[event["name"].removesuffix("_kernel_time")].append(event["dur"] / 1e6)
    return {name: min(durations) for name, durations in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", default=DEFAULT_MODEL)
    parser.add_argument("--threads", type=int, default=usable_cores())
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args()
    folder = graph_folder(options.model)
    if folder is None:
        parser.error(f"{options.model} is neither a shipped model with graphs nor a folder of graphs")
    path = folder / "search.onnx"
    peaks = {kind: peak(kind == "int8", options.threads, options.rounds) for kind in ("fp32", "int8")}
    print(f"{options.threads} threads; peak: " + ", ".join(f"{k} {v / 1e9:.1f} GMAC/s" for k, v in peaks.items()))
    model = onnx.load(path)
    size = json.loads(next(p.value for p in model.metadata_props if p.key == "spec"))["search_size"]
    macs = layer_macs(model, size)
    kind = precision(folder)
    times = layer_times(path, size, options.threads, options.rounds)
    print(f"{'layer':20} {'GMAC':>7} {'ms':>7} {'GMAC/s':>7}  of the {kind} peak")

    def row(name: str, count: int, spent: float) -> None:
        speed = count / spent
        print(f"{name:20} {count / 1e9:7.3f} {spent * 1e3:7.3f} {speed / 1e9:7.1f}  {speed / peaks[kind]:.0%}")

    rest = dict(times)
    for layer, count in sorted(macs.items(), key=lambda item: -item[1]):
        # onnxruntime appends to the names of what it fuses
        own = [name for name in times if name == layer or name.startswith((f"{layer}_", f"{layer}.relu"))]
        if own:  # the last layers may have gone into what follows them
            row(layer, count, sum(rest.pop(name) for name in own))
    print(f"{'everything else':20} {'':7} {sum(rest.values()) * 1e3:7.3f}")
    row("search graph", sum(macs.values()), sum(times.values()))


if __name__ == "__main__":
    main()
