"""Exported models: a folder with the graphs `template` and `search`, each of which carries the model's description."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from psiamfcpp.errors import UserError
from psiamfcpp.spec import ModelSpec

GRAPH_FORMAT = "psiamfcpp-graph/1"
GRAPHS = ("template", "search")


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
    data = search.read_bytes()
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
