"""Time three forms of the depth-wise correlation, with kernels that are inputs, in onnxruntime.

    python benchmarks/correlation.py [--threads 1] [--rounds 50]

Prints, for 512 channels of 26x26 with kernels of 4x4: a grouped convolution whose weight is an input, sixteen shifted
products, and unfolded patches times kernels. Needs the extra `train` (onnx).
"""

import argparse
import time
from itertools import product

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from psiamfcpp.runtime.onnx_engine import open_session

CHANNELS, SIDE, KERNEL = 512, 26, 4
OUT = SIDE - KERNEL + 1


def shifted(constants, nodes, tensor, top, left, height, width):
    """Add a slice of height x width from (top, left); return its name."""
    name = f"{tensor}_{top}_{left}"
    for key, value in (("from", [top, left]), ("to", [top + height, left + width]), ("axes", [2, 3])):
        constants.append(numpy_helper.from_array(np.array(value), f"{name}_{key}"))
    nodes.append(helper.make_node("Slice", [tensor, f"{name}_from", f"{name}_to", f"{name}_axes"], [name]))
    return name


def grouped():
    shape = numpy_helper.from_array(np.array([CHANNELS, 1, KERNEL, KERNEL]), "shape")
    nodes = [helper.make_node("Reshape", ["k", "shape"], ["w"])]
    return [*nodes, helper.make_node("Conv", ["x", "w"], ["y"], group=CHANNELS)], [shape]


def sixteen_products():
    nodes, constants, terms = [], [], []
    for i, j in product(range(KERNEL), repeat=2):
        part = shifted(constants, nodes, "x", i, j, OUT, OUT)
        weight = shifted(constants, nodes, "k", i, j, 1, 1)
        nodes.append(helper.make_node("Mul", [part, weight], [f"term_{i}_{j}"]))
        terms.append(f"term_{i}_{j}")
    return [*nodes, helper.make_node("Sum", terms, ["y"])], constants


def unfolded():
    nodes, constants, rows = [], [], []
    shapes = {"row": [0, 0, 1, -1], "kernel": [0, 0, 1, KERNEL**2], "out": [0, 0, OUT, OUT]}
    constants += [numpy_helper.from_array(np.array(shape), name) for name, shape in shapes.items()]
    for i, j in product(range(KERNEL), repeat=2):
        rows.append(f"row_{i}_{j}")
        part = shifted(constants, nodes, "x", i, j, OUT, OUT)
        nodes.append(helper.make_node("Reshape", [part, "row"], [rows[-1]]))
    nodes.append(helper.make_node("Concat", rows, ["patches"], axis=2))
    nodes.append(helper.make_node("Reshape", ["k", "kernel"], ["flat"]))
    nodes.append(helper.make_node("MatMul", ["flat", "patches"], ["sums"]))
    return [*nodes, helper.make_node("Reshape", ["sums", "out"], ["y"])], constants


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=50)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    feed = {"x": rng.standard_normal((1, CHANNELS, SIDE, SIDE)).astype(np.float32)}
    feed["k"] = rng.standard_normal((1, CHANNELS, KERNEL, KERNEL)).astype(np.float32)
    expected = None
    for form in (grouped, sixteen_products, unfolded):
        nodes, constants = form()
        inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, value.shape) for name, value in feed.items()]
        output = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, CHANNELS, OUT, OUT])
        graph = helper.make_graph(nodes, form.__name__, inputs, [output], constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        session = open_session(model.SerializeToString(), options.threads)
        times = []
        for _ in range(options.rounds):
            start = time.perf_counter()
            (found,) = session.run(None, feed)
            times.append(time.perf_counter() - start)
        expected = found if expected is None else expected
        assert np.allclose(found, expected, atol=1e-4), form.__name__
        print(f"{form.__name__:18} {np.median(times) * 1e3:7.2f} ms, at best {min(times) * 1e3:.2f}")


if __name__ == "__main__":
    main()
