"""Exported models: a folder with the graphs `template` and `search`, each of which carries the model's description."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from psiamfcpp.errors import UserError
from psiamfcpp.files import read_bytes
from psiamfcpp.spec import ModelSpec

GRAPH_FORMAT = "psiamfcpp-graph/1"
GRAPHS = ("template", "search")
# What `psiamfcpp export` writes. Others, as ConstantOfShape, take memory without bound from a few bytes.
_WRITTEN = """
Abs Add Cast Clip Concat Conv ConvInteger DequantizeLinear Div Erf Exp Expand GlobalAveragePool Identity Max MaxPool
Min Mul Pad QuantizeLinear Range ReduceMax ReduceProd Relu Reshape Shape Sigmoid Split Squeeze Sub Transpose Unsqueeze
"""
_OPERATORS = frozenset(_WRITTEN.split())
# Numbers of fields in onnx.proto.
_MODEL_GRAPH, _MODEL_FUNCTIONS, _GRAPH_NODE, _NODE_OPERATOR, _NODE_ATTRIBUTE, _INNER_GRAPHS = 7, 25, 1, 4, 5, (6, 11)


def graph_files(folder: Path, suffixes: tuple[str, ...]) -> tuple[Path, Path]:
    """Return the files of the template and the search graph, in the first of the formats that the folder has.

    Raises:
        UserError: the folder lacks a graph in every one of them.
    """
    found = find_graphs(folder, suffixes)
    if found is None:
        expected = " or ".join(f"template{suffix} and search{suffix}" for suffix in suffixes)
        raise UserError(f"{folder} does not hold {expected}: write them with `psiamfcpp export MODEL -o DIR`")
    return found


def find_graphs(folder: Path, suffixes: tuple[str, ...]) -> tuple[Path, Path] | None:
    """Return what `graph_files` returns, and None where that raises."""
    for suffix in suffixes:
        template, search = (folder / f"{graph}{suffix}" for graph in GRAPHS)
        if template.is_file() and search.is_file():
            return template, search
    return None


def precision(folder: Path) -> str:
    """Return whether the search graph in a folder computes in ``fp32`` or ``int8``."""
    return graph_precision(graph_files(folder, (".onnx", ".xml"))[1])


def graph_precision(search: Path) -> str:
    """Return whether a search graph computes in ``fp32`` or ``int8``."""
    # ONNX and OpenVINO name their operators as plain text.
    data = read_bytes(search, "graph", "export the model again")
    return "int8" if b"QuantizeLinear" in data or b"FakeQuantize" in data else "fp32"


def read_spec(metadata: Mapping[str, str], origin: Path) -> ModelSpec:
    """The description in a graph's metadata.

    Raises:
        UserError: the graph is not ours, or of another version.
    """
    found = metadata.get("format")
    if found != GRAPH_FORMAT:
        what = f"is {found}" if found else "was not written by psiamfcpp"
        raise UserError(f"graph {origin} {what}, {GRAPH_FORMAT} is needed: export the model again")
    try:
        return ModelSpec.from_json(metadata.get("spec", ""))
    except UserError as error:
        raise UserError(f"graph {origin}: {error}") from None


def check_onnx(path: Path) -> None:
    """Refuse an ONNX file with anything but the operators that `psiamfcpp export` writes, before it is loaded.

    Raises:
        UserError: there is no such file, it is damaged, or it holds another operator.
    """
    content = memoryview(read_bytes(path, "graph", "export the model again"))
    try:
        unknown = sorted(set(_operators(content)) - _OPERATORS)
    except (ValueError, IndexError) as error:
        raise damaged(path, error) from None
    if unknown:
        raise UserError(f"graph {path} holds {unknown[0][:60]!r}, which no export writes: export the model again")


def _operators(model: memoryview) -> Iterator[str]:
    for number, graph in _fields(model):
        if number == _MODEL_FUNCTIONS:
            yield "a function"
        for part, node in _fields(graph) if number == _MODEL_GRAPH else ():
            for key, value in _fields(node) if part == _GRAPH_NODE else ():
                if key == _NODE_OPERATOR:
                    yield bytes(value).decode(errors="replace")
                elif key == _NODE_ATTRIBUTE and any(inner in _INNER_GRAPHS for inner, _ in _fields(value)):
                    yield "a graph within a node"


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Numbers and contents of the fields of a message of protobuf; numbers and the like have no content."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        kind, size = key & 7, 0
        if kind == 0:
            _, at = _varint(message, at)
        elif kind == 2:
            size, at = _varint(message, at)
        elif kind in (1, 5):
            at += 8 if kind == 1 else 4
        else:
            raise ValueError(f"a field of type {kind}")
        if at + size > len(message):
            raise ValueError("it is cut off")
        yield key >> 3, message[at : at + size]
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for place in range(10):
        byte = message[at + place]
        value |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return value, at + place + 1
    raise ValueError("a number without end")


def same_model(template: Path, template_spec: ModelSpec, search: Path, search_spec: ModelSpec) -> None:
    """Raise unless both graphs describe one model.

    Raises:
        UserError: they don't.
    """
    if template_spec != search_spec:
        raise UserError(f"{template} and {search} are of different models: export the model again")


def damaged(path: Path, error: Exception) -> UserError:
    """Return what to say of a file that the runtime cannot load."""
    reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
    return UserError(f"graph {path} cannot be loaded ({reason}): the file is damaged, export the model again")
