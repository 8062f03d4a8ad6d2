"""The onnxruntime engine: runs exported graphs, the default."""

from __future__ import annotations

import contextlib
import functools
import io
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.machine import usable_cores
from psiamfcpp.runtime.device import CPU, Device, DeviceKind
from psiamfcpp.runtime.engine import Float32Array
from psiamfcpp.runtime.graph_engine import GraphEngine, Kernels, Template
from psiamfcpp.runtime.graph_file import damaged, read_spec
from psiamfcpp.runtime.lanes import Search
from psiamfcpp.spec import ModelSpec

# Two wheels hold the same package onnxruntime: the one that was installed last overwrote the other's files, and
# removing either takes files from both. So both must go before one is installed.
_WHEELS = ("onnxruntime", "onnxruntime-gpu")
# What a provider leaves to others is computed by the next in the list.
_PROVIDERS: dict[DeviceKind, tuple[str, ...]] = {
    "cpu": ("CPUExecutionProvider",),
    "cuda": ("CUDAExecutionProvider", "CPUExecutionProvider"),
    "tensorrt": ("TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"),
}


# The graph c = MatMulInteger(a, b) of uint8 and int8, here in bytes, since the package onnx is only needed to export.
_PRODUCT = bytes.fromhex(
    "08053a3e0a180a01610a0162120163220d4d61744d756c496e74656765721201705a090a016112040a0208025a090a016212040a0208036209"
    "0a016312040a02080642040a00100a"
)


class OnnxEngine(GraphEngine):
    """See `psiamfcpp.runtime.engine.Engine`."""

    name = "onnx"

    def _open_template(self, path: Path, threads: int, device: Device) -> tuple[Template, ModelSpec]:
        session = _open(path, threads, None, device)
        return functools.partial(_template, session), _spec(session, path)

    def _open_search(
        self, path: Path, search_size: int, threads: int, lanes: int, device: Device
    ) -> tuple[list[Search], ModelSpec]:
        # a session may run in many threads at once
        session = _open(path, threads, search_size, device)
        names = [given.name for given in session.get_inputs()]
        return [functools.partial(_search, session, names)] * lanes, _spec(session, path)


def open_session(
    graph: str | bytes, threads: int | None, search_size: int | None = None, device: Device = CPU
) -> onnxruntime.InferenceSession:
    """Return a session on a graph file or its bytes, made for search crops of that size in pixels.

    Raises:
        UserError: the installed onnxruntime cannot compute on the device.
    """
    providers = _providers(device)
    # With its fallback, onnxruntime prints a failure of the GPU and computes on the processor instead.
    session = onnxruntime.InferenceSession(
        graph, session_options(threads, search_size), providers=providers, enable_fallback=0
    )
    if _PROVIDERS[device.kind][0] not in session.get_providers():
        # A provider whose libraries are missing is left out without an error.
        raise _cannot(f"start {_PROVIDERS[device.kind][0]}", device, _preloaded())
    return session


def session_options(threads: int | None, search_size: int | None = None) -> onnxruntime.SessionOptions:
    """Return the options of a session with that many threads, made for search crops of that size in pixels."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    # By itself onnxruntime counts the machine's cores, not those that this process may use, and its threads would
    # wait for each other in busy loops.
    options.intra_op_num_threads = threads or usable_cores()
    # Between two searches its threads would go on in busy loops, and decoding, drawing and other sessions wait.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    # Threads take smaller and smaller blocks of a layer, so that none waits long for the last.
    options.add_session_config_entry("session.dynamic_block_base", "4")
    if products_saturate():
        # Products are then summed in 32 bits, for the same boxes as everywhere else.
        options.add_session_config_entry("session.x64quantprecision", "1")
    if search_size is not None:
        # With its size known at load, onnxruntime lays out memory and folds the grid of cells once.
        options.add_free_dimension_override_by_name("size", search_size)
    return options


@functools.cache
def products_saturate() -> bool:
    """Return whether onnxruntime adds products of 8 bits in 16 bits here, where they saturate: x86 without VNNI.

    A product is computed to find out. The option that prevents it is set only then, since with VNNI it would cost half
    of the speed and change nothing: onnxruntime does not tell these processors apart.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(_PRODUCT, options, providers=["CPUExecutionProvider"])
    left, right = np.full((8, 8), 255, np.uint8), np.full((8, 8), 127, np.int8)
    (sums,) = session.run(None, {"a": left, "b": right})
    return bool((sums != 8 * 255 * 127).any())


def _providers(device: Device) -> list[Any]:
    """Return the providers of a device, with their options.

    Raises:
        UserError: the installed onnxruntime is damaged, or lacks the device's provider.
    """
    wanted = _PROVIDERS[device.kind]
    install = "onnxruntime" if device.kind == "cpu" else "'onnxruntime-gpu[cuda,cudnn]'"
    fix = f"pip uninstall -y {' '.join(_WHEELS)} && pip install {install}"
    if not hasattr(onnxruntime, "InferenceSession"):
        raise UserError(f"the installed onnxruntime is incomplete, as after one of two wheels was removed: {fix}")
    if device.kind == "cpu":
        return list(wanted)
    if wanted[0] not in onnxruntime.get_available_providers():
        if all(map(_installed, _WHEELS)):
            raise UserError(f"{' and '.join(_WHEELS)} are both installed and overwrite each other: {fix}")
        raise UserError(f"device {device}: the installed onnxruntime has no {wanted[0]}: {fix}")
    _preloaded()
    options = {
        "TensorrtExecutionProvider": {"device_id": device.index},
        # By default float convolutions are computed with 10 bits of mantissa (TF32), which is not fp32.
        "CUDAExecutionProvider": {"device_id": device.index, "use_tf32": 0},
        "CPUExecutionProvider": {},
    }
    return [(name, options[name]) for name in wanted]


@functools.cache
def _preloaded() -> str:
    """Load CUDA and cuDNN from wheels of their own, where the system's loader does not look; return complaints."""
    if not hasattr(onnxruntime, "preload_dlls"):
        return ""
    # It prints what it does not find.
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        onnxruntime.preload_dlls()
    return printed.getvalue()


def _cannot(do: str, device: Device, complaint: str) -> UserError:
    # The cause stands at the end of a line that begins with places in the source.
    cause = f" ({lines[0][-200:].strip()})" if (lines := complaint.strip().splitlines()) else ""
    own = " and TensorRT, which has an installer of its own" if device.kind == "tensorrt" else ""
    return UserError(
        f"onnxruntime cannot {do} on {device}{cause}: it needs a GPU, its driver, CUDA and cuDNN of the versions that "
        f"pip install 'onnxruntime-gpu[cuda,cudnn]=={onnxruntime.__version__}' brings{own}"
    )


def _installed(wheel: str) -> bool:
    try:
        version(wheel)
    except PackageNotFoundError:
        return False
    return True


def _open(path: Path, threads: int, search_size: int | None, device: Device) -> onnxruntime.InferenceSession:
    try:
        return open_session(str(path), threads, search_size, device)
    except UserError:
        raise
    except Exception as error:  # onnxruntime's errors have no common base of their own
        if device.kind != "cpu":
            raise _cannot(f"load {path}", device, str(error) or type(error).__name__) from None
        raise damaged(path, error) from None


def _spec(session: onnxruntime.InferenceSession, path: Path) -> ModelSpec:
    return read_spec(session.get_modelmeta().custom_metadata_map, path)


def _template(session: onnxruntime.InferenceSession, crop: Image) -> Kernels:
    return tuple(session.run(None, {"crop": crop[None]}))


def _search(
    session: onnxruntime.InferenceSession, names: list[str], crop: Image, kernels: Kernels
) -> tuple[Float32Array, Float32Array]:
    # The crop is the first input, and the kernels follow as the template graph gives them.
    feed = dict(zip(names, (crop[None], *kernels), strict=True))
    scores, boxes = session.run(("scores", "boxes"), feed)
    return scores[0], boxes[0]
