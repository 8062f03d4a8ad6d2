"""Shipped models, each with a model card.

A model NAME is a checkpoint, ``NAME.safetensors``, to look into and to train on; the folders ``NAME`` and ``NAME-int8``
hold the graphs that were exported from it, to track with. The package holds the 8-bit graphs of the pruned models. The
rest lies in a distribution of its own, ``psiamfcpp-weights``, and is found once that is installed.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib.util
from pathlib import Path

from psiamfcpp.errors import UserError
from psiamfcpp.files import is_file

DEFAULT_MODEL = "psiamfcpp-alexnet-int8"

_FOLDER = Path(__file__).parent
_WEIGHTS = "psiamfcpp_weights"
# What the distribution of weights holds, so that it can be named where it is missing.
_ELSEWHERE = (
    "plightfc",
    "plightfc-s",
    "psiamfcpp-alexnet",
    "psiamfcpp-alexnet-n",
    "psiamfcpp-alexnet-s",
    "siamfcpp-alexnet",
    "siamfcpp-alexnet-int8",
)


def _folders() -> list[Path]:
    found = importlib.util.find_spec(_WEIGHTS)
    return [_FOLDER, *map(Path, found.submodule_search_locations or () if found else ())]


def names() -> list[str]:
    """Names of the shipped checkpoints."""
    return sorted(path.stem for folder in _folders() for path in folder.glob("*.safetensors"))


def graph_names() -> list[str]:
    """Names of the shipped folders of graphs."""
    return sorted(path.parent.name for folder in _folders() for path in folder.glob("*/search.onnx"))


def weights_path(path_or_name: str | Path) -> Path:
    """The checkpoint of a shipped model's name, or the path itself if it exists.

    Raises:
        UserError: neither a shipped model nor a file; names the nearest model.
    """
    if str(path_or_name) in names():
        return next(path for folder in _folders() if (path := folder / f"{path_or_name}.safetensors").exists())
    path = Path(path_or_name)
    if is_file(path):
        return path
    if str(path_or_name) in _ELSEWHERE and importlib.util.find_spec(_WEIGHTS) is None:
        raise UserError(
            f"model {str(path_or_name)!r} is part of psiamfcpp-weights, which is not installed: "
            "in a clone of psiamfcpp, pip install ./weights"
        )
    if graph_folder(path_or_name):
        raise UserError(
            f"model {str(path_or_name)!r} holds graphs only, and this needs a checkpoint: {_known(names())}"
        )
    every = sorted({*names(), *graph_names()})
    near = difflib.get_close_matches(str(path_or_name), every, n=1)
    hint = f"did you mean {near[0]!r}?" if near else _known(every)
    raise UserError(f"model {str(path_or_name)!r} is neither a file nor a shipped model: {hint}")


def graph_folder(path_or_name: str | Path) -> Path | None:
    """The folder of graphs of a shipped model's name, or the path itself if it is one; None if there is none."""
    if str(path_or_name) in graph_names():
        return next(path for folder in _folders() if (path := folder / str(path_or_name)).is_dir())
    path = Path(path_or_name)
    with contextlib.suppress(OSError, ValueError):
        return path if any(path.glob("search.*")) else None
    return None


def model_files(path_or_name: str | Path) -> list[Path]:
    """Return the files of a model, by name: its graphs, or its checkpoint.

    Raises:
        UserError: neither a shipped model nor a file; names the nearest model.
    """
    folder = graph_folder(path_or_name)
    return sorted(path for path in folder.iterdir() if path.is_file()) if folder else [weights_path(path_or_name)]


def _known(found: list[str]) -> str:
    return f"shipped models are {', '.join(found) or 'none'}"
