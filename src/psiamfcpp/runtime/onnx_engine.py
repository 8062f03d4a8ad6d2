"""The onnxruntime engine: runs exported graphs, the default."""

from __future__ import annotations

from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import onnxruntime

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.machine import usable_cores
from psiamfcpp.runtime.device import CPU, Device, DeviceKind
from psiamfcpp.runtime.engine import Float32Array
from psiamfcpp.runtime.graph_engine import GraphEngine, Kernels, Template
from psiamfcpp.runtime.graph_file import damaged, read_spec, reason
from psiamfcpp.runtime.lanes import Search
from psiamfcpp.spec import ModelSpec

# Two wheels hold the same package onnxruntime: the one that was installed last overwrote the other's files, and
# removing either takes files from both. So both must go before one is installed.
_WHEELS = ("onnxruntime", "onnxruntime-gpu")
_GPU_WHEEL = f"pip uninstall -y {' '.join(_WHEELS)} && pip install 'onnxruntime-gpu[cuda,cudnn]'"
# What a provider leaves to others is computed by the next in the list.
_PROVIDERS: dict[DeviceKind, tuple[str, ...]] = {
    "cpu": ("CPUExecutionProvider",),
    "cuda": ("CUDAExecutionProvider", "CPUExecutionProvider"),
    "tensorrt": ("TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"),
}


class OnnxEngine(GraphEngine):
    """See `psiamfcpp.runtime.engine.Engine`."""

    name = "onnx"

    def _open_template(self, path: Path, threads: int, device: Device) -> tuple[Template, ModelSpec]:
        session = _open(path, threads, None, device)
        return partial(_template, session), _spec(session, path)

    def _open_search(
        self, path: Path, search_size: int, threads: int, lanes: int, device: Device
    ) -> tuple[list[Search], ModelSpec]:
        # a session may run in many threads at once
        session = _open(path, threads, search_size, device)
        return [partial(_search, session)] * lanes, _spec(session, path)


def open_session(
    graph: str | bytes, threads: int | None, search_size: int | None = None, device: Device = CPU
) -> onnxruntime.InferenceSession:
    """Return a session on a graph file or its bytes, made for search crops of that size in pixels.

    Raises:
        UserError: the installed onnxruntime cannot compute on the device.
    """
    providers = _providers(device)
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
    # Without `enable_fallback=0` a failure on the card is printed, and the processor computes instead.
    session = onnxruntime.InferenceSession(graph, options, providers=providers, enable_fallback=0)
    first = _PROVIDERS[device.kind][0]
    if first not in session.get_providers():
        # A provider whose libraries are missing is left out without an error.
        raise UserError(
            f"onnxruntime cannot start {first} on {device}: it needs a card, its driver, and the libraries that "
            f"belong to onnxruntime-gpu {onnxruntime.__version__} (CUDA and cuDNN, for tensorrt TensorRT as well)"
        )
    return session


def _providers(device: Device) -> list[Any]:
    """Return the providers of a device, with their options.

    Raises:
        UserError: the installed onnxruntime is damaged, or lacks the device's provider.
    """
    if not hasattr(onnxruntime, "InferenceSession"):
        raise UserError(
            "the installed onnxruntime is incomplete, as after one of two wheels was removed: "
            f"pip uninstall -y {' '.join(_WHEELS)} && pip install onnxruntime"
        )
    wanted = _PROVIDERS[device.kind]
    if device.kind == "cpu":
        return list(wanted)
    if wanted[0] not in onnxruntime.get_available_providers():
        both = all(map(_installed, _WHEELS))
        what = f"{' and '.join(_WHEELS)} are both installed and overwrite each other" if both else ""
        raise UserError(f"device {device}: {what or f'the installed onnxruntime has no {wanted[0]}'}: {_GPU_WHEEL}")
    if hasattr(onnxruntime, "preload_dlls"):
        # CUDA and cuDNN lie in wheels of their own, where the system's loader does not look.
        onnxruntime.preload_dlls()
    options = {
        "TensorrtExecutionProvider": {"device_id": device.index},
        # By default float convolutions are computed with 10 bits of mantissa (TF32), which is not fp32.
        "CUDAExecutionProvider": {"device_id": device.index, "use_tf32": 0},
        "CPUExecutionProvider": {},
    }
    return [(name, options[name]) for name in wanted]


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
            raise UserError(f"graph {path} cannot be loaded on {device}: {reason(error)}") from None
        raise damaged(path, error) from None


def _spec(session: onnxruntime.InferenceSession, path: Path) -> ModelSpec:
    return read_spec(session.get_modelmeta().custom_metadata_map, path)


def _template(session: onnxruntime.InferenceSession, crop: Image) -> Kernels:
    cls, reg = session.run(("cls_kernel", "reg_kernel"), {"crop": crop[None]})
    return cls, reg


def _search(session: onnxruntime.InferenceSession, crop: Image, kernels: Kernels) -> tuple[Float32Array, Float32Array]:
    feed = {"crop": crop[None], "cls_kernel": kernels[0], "reg_kernel": kernels[1]}
    scores, boxes = session.run(("scores", "boxes"), feed)
    return scores[0], boxes[0]
