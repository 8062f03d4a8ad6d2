"""The two calls behind which every engine runs a model: numpy in, numpy out."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.spec import ModelSpec
from psiamfcpp.zoo import DEFAULT_MODEL

Float32Array = NDArray[np.float32]

ENGINES = ("torch",)


class Engine(Protocol):
    """A loaded model."""

    spec: ModelSpec
    """its description; ``spec.search_size`` is the size that `search` takes"""

    def template(self, crop: Image) -> Any:
        """Correlation kernels of a template crop ``(127, 127, 3)``, uint8, BGR; only this engine can read them."""
        ...

    def search(self, crop: Image, kernels: Any) -> tuple[Float32Array, Float32Array]:
        """Scores ``(N, N)`` and boxes ``(N, N, 4)``, x0, y0, x1, y1 in the crop, of a crop ``(S, S, 3)`` uint8 BGR."""
        ...


def open_engine(
    model: str = DEFAULT_MODEL,
    engine: str | None = None,
    threads: int | None = None,
    search_size: int | None = None,
) -> Engine:
    """Load a model into an engine and warm it up.

    Args:
        model: name of a shipped model, or a model file.
        engine: one of `ENGINES`; by default the fastest that can run this model here.
        threads: threads that the engine may use; by default as many as there are cores.
        search_size: side of the search crop in pixels; by default the model's own.

    Raises:
        UserError: unknown model, engine or size, or an engine that is not installed.
    """
    if engine not in (None, *ENGINES):
        raise UserError(f"unknown engine {engine!r}: known are {', '.join(ENGINES)}")
    if threads is not None and threads < 1:
        raise UserError(f"threads is {threads}: it must be at least 1")
    try:
        from psiamfcpp.runtime.torch_engine import TorchEngine
    except ModuleNotFoundError as error:
        raise UserError(f"the torch engine needs {error.name}: pip install 'psiamfcpp[train]'") from None
    return TorchEngine(model, threads, search_size)
