"""Opens a model in an engine: the table of engines, and what follows from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal, cast

from psiamfcpp.errors import UserError
from psiamfcpp.runtime.device import DeviceKind, parse_device
from psiamfcpp.runtime.engine import Engine
from psiamfcpp.runtime.graph_file import find_graphs, graph_files
from psiamfcpp.zoo import DEFAULT_MODEL, graph_folder, names, weights_path

Form = Literal["graphs", "checkpoint"]


@dataclass(frozen=True)
class EngineKind:
    """What is known of an engine before it is imported.

    Its class is made with ``(source, threads, search_size, device)``. The source is the pair of paths of the template
    and search graph for the form ``graphs``, and the checkpoint's name or path for the form ``checkpoint``.
    """

    module: str
    """module of the class, imported when the engine is first opened"""
    class_name: str
    install: str
    """what pip installs to have it"""
    form: Form
    """what it runs"""
    suffixes: tuple[str, ...]
    """of the graph files that it reads; of several that are there the first is taken"""
    devices: tuple[DeviceKind, ...]


_PACKAGE = "psiamfcpp.runtime"
# More than any machine has cores; a million would take minutes to start.
_MOST_THREADS = 1024
# The first engine of a form is that form's default.
KINDS: Mapping[str, EngineKind] = {
    "onnx": EngineKind(
        f"{_PACKAGE}.onnx_engine", "OnnxEngine", "onnxruntime", "graphs", (".onnx",), ("cpu", "cuda", "tensorrt")
    ),
    "openvino": EngineKind(
        f"{_PACKAGE}.openvino_engine", "OpenVinoEngine", "psiamfcpp[openvino]", "graphs", (".xml", ".onnx"), ("cpu",)
    ),
    "torch": EngineKind(
        f"{_PACKAGE}.torch_engine", "TorchEngine", "psiamfcpp[train]", "checkpoint", (), ("cpu", "cuda")
    ),
}
ENGINES = tuple(KINDS)
"""names of the engines"""


def open_engine(
    model: str = DEFAULT_MODEL,
    engine: str | None = None,
    threads: int | None = None,
    search_size: int | None = None,
    device: str = "cpu",
) -> Engine:
    """Load a model into an engine and warm it up.

    Args:
        model: name of a shipped model, a checkpoint, or a folder that `psiamfcpp export` wrote.
        engine: one of `ENGINES`; by default onnx for exported graphs and torch for a checkpoint.
        threads: threads that the engine may use on the processor; by default as many as there are usable cores.
        search_size: side of the search crop in pixels; by default the model's own.
        device: ``cpu``; ``cuda`` (engines onnx and torch) or ``tensorrt`` (onnx) for a GPU, whose number may
            follow as in ``cuda:1``. On ``cuda`` torch computes in half precision.

    Raises:
        UserError: unknown model, engine, device or size; an engine that is not installed, or that cannot run this
            model or use this device.
    """
    if engine not in (None, *ENGINES):
        raise UserError(f"unknown engine {engine!r}: known are {', '.join(ENGINES)}")
    if threads is not None and not 1 <= threads <= _MOST_THREADS:
        raise UserError(f"threads is {threads}: it must be from 1 to {_MOST_THREADS}")
    place = parse_device(device)
    graphs = graph_folder(model)
    name = engine or _named(form="checkpoint" if graphs is None else "graphs")[0]
    kind = KINDS[name]
    if place.kind not in kind.devices:
        others = _or(_named(device=place.kind))
        raise UserError(f"the {name} engine does not compute on {place.kind}: choose the engine {others}")
    _check_form(model, name, graphs)
    try:
        made = getattr(import_module(kind.module), kind.class_name)
    except ModuleNotFoundError as error:
        raise UserError(f"the {name} engine needs {error.name}: pip install '{kind.install}'") from None
    source = model if graphs is None or kind.form == "checkpoint" else graph_files(graphs, kind.suffixes)
    return cast(Engine, made(source, threads, search_size, place))


def runs(engine: str, model: str) -> bool:
    """Return whether a model is there in the form that an engine runs, be the engine installed or not.

    Args:
        engine: one of `ENGINES`.
        model: name of a shipped model, a checkpoint, or a folder of graphs.
    """
    kind, graphs = KINDS[engine], graph_folder(model)
    if kind.form == "checkpoint":
        return graphs is None or model in names()
    return graphs is not None and find_graphs(graphs, kind.suffixes) is not None


def forms() -> str:
    """Return which engines run what, as a part of a sentence."""
    return ", ".join(f"{text} run on {_and(_named(form=form))}" for form, text in _FORMS.items())


_FORMS: dict[Form, str] = {"graphs": "graphs", "checkpoint": "checkpoints"}


def _check_form(model: str, name: str, graphs: Path | None) -> None:
    """Raise unless the model is there in the form that the engine runs."""
    if KINDS[name].form == "checkpoint":
        if graphs is not None and model not in names():
            others = _or(_named(form="graphs"))
            raise UserError(f"the {name} engine runs checkpoints, and {model} holds graphs: choose the engine {others}")
        weights_path(model)
    elif graphs is None:
        weights_path(model)
        fix = f"`psiamfcpp export {model} -o DIR`, then use DIR as the model"
        raise UserError(f"the {name} engine runs graphs, and this is a checkpoint: {fix}")


def _named(form: Form | None = None, device: DeviceKind | None = None) -> list[str]:
    """Return the engines that run a form, or compute on a device."""
    return [
        name
        for name, kind in KINDS.items()
        if (form is None or kind.form == form) and (device is None or device in kind.devices)
    ]


def _or(words: list[str]) -> str:
    return " or ".join(words)


def _and(words: list[str]) -> str:
    return " and ".join(words)
