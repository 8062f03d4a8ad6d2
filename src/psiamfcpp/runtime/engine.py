"""The contract behind which every engine runs a model: numpy arrays in, numpy arrays out."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.spec import ModelSpec

Float32Array = NDArray[np.float32]
Images = NDArray[np.uint8]


@runtime_checkable
class Engine(Protocol):
    """A loaded model, ready to run.

    Any object with these members is an engine; it need not inherit from this class. Crops are uint8, BGR, without any
    normalisation. A caller may reuse the buffer of a crop as soon as a call returns, and may keep every array that
    was returned: an engine neither keeps the one nor overwrites the other.
    """

    @property
    def name(self) -> str:
        """Short name, as tables show it: ``onnx``, ``openvino``, ``torch``, or one of your own."""
        ...

    @property
    def device(self) -> str:
        """Where it computes: ``cpu``, ``cuda:0``, ``tensorrt:0``, ..."""
        ...

    @property
    def precision(self) -> str:
        """Number format of the weights in `search`, as loaded: ``fp32``, ``fp16`` or ``int8``."""
        ...

    @property
    def spec(self) -> ModelSpec:
        """The model's description; ``spec.search_size`` is the side in pixels of the crops that `search` takes."""
        ...

    def template(self, crop: Image) -> Any:
        """Return what `search` correlates with, from a template crop ``(Z, Z, 3)`` of ``spec.template_size``.

        They may be of any type: nobody but this engine reads them.
        """
        ...

    def search(self, crop: Image, kernels: Any) -> tuple[Float32Array, Float32Array]:
        """Return scores and boxes of a search crop.

        Args:
            crop: ``(S, S, 3)``, where S is ``spec.search_size``.
            kernels: what `template` returned.

        Returns:
            Scores ``(N, N)``, 0 to 1, and boxes ``(N, N, 4)`` as x0, y0, x1, y1 in pixels of the crop. N is
            ``spec.arch.score_size(S)``, and row by row the cells lie ``spec.arch.stride`` pixels apart.
        """
        ...

    def search_many(self, crops: Images, kernels: list[Any]) -> tuple[Float32Array, Float32Array]:
        """Return scores ``(B, N, N)`` and boxes ``(B, N, N, 4)`` of crops ``(B, S, S, 3)``, each with its own kernels.

        The results are those of `search` on each crop by itself.
        """
        ...


def resized(spec: ModelSpec, search_size: int | None) -> ModelSpec:
    """Return the description with another search size in pixels; None leaves it as it is.

    Raises:
        UserError: the size does not fit the network.
    """
    return spec if search_size is None else dataclasses.replace(spec, search_size=search_size)


def warm_up(engine: Engine) -> None:
    """Run an engine once, so that the first frame takes no longer than later ones.

    Raises:
        UserError: what it returns is not of the right shape, or not finite.
    """
    rng = np.random.default_rng(0)
    sides = (engine.spec.template_size, engine.spec.search_size)
    z, x = (rng.integers(0, 256, (side, side, 3), np.uint8) for side in sides)
    scores, boxes = engine.search(x, engine.template(z))
    cells = engine.spec.arch.score_size(engine.spec.search_size)
    if scores.shape != (cells, cells) or boxes.shape != (cells, cells, 4):
        raise UserError(f"the model gives maps of {scores.shape} and {boxes.shape} for {cells} cells: export it again")
    if not (np.isfinite(scores).all() and np.isfinite(boxes).all()):
        raise UserError("the model gives values that are not finite: export it again")
