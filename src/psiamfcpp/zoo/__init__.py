"""Weights shipped inside the package, each with a model card of the same name."""

from __future__ import annotations

import difflib
from pathlib import Path

from psiamfcpp.errors import UserError

DEFAULT_MODEL = "siamfcpp-alexnet"

_FOLDER = Path(__file__).parent


def names() -> list[str]:
    """Names of the shipped models."""
    return sorted(path.stem for path in _FOLDER.glob("*.safetensors"))


def weights_path(path_or_name: str | Path) -> Path:
    """The file of a shipped model's name, or the path itself if it exists.

    Raises:
        UserError: neither a shipped model nor a file; names the nearest model.
    """
    if str(path_or_name) in names():
        return _FOLDER / f"{path_or_name}.safetensors"
    path = Path(path_or_name)
    if path.is_file():
        return path
    near = difflib.get_close_matches(str(path_or_name), names(), n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"shipped models are {', '.join(names()) or 'none'}"
    raise UserError(f"model {str(path_or_name)!r} is neither a file nor a shipped model: {hint}")
