"""The torch engine: runs a checkpoint as it is, in float32."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from psiamfcpp.geometry import Image
from psiamfcpp.models import load
from psiamfcpp.models.network import Kernels
from psiamfcpp.runtime.engine import Float32Array


class TorchEngine:
    """See `psiamfcpp.runtime.engine.Engine`."""

    def __init__(self, model: str, threads: int | None = None, search_size: int | None = None):
        self._model = load(model)
        self._model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.spec = self._model.spec
        if search_size is not None:
            self.spec = dataclasses.replace(self.spec, search_size=search_size)
        if threads is not None:
            torch.set_num_threads(threads)
        self._warm_up()

    @torch.inference_mode()
    def template(self, crop: Image) -> Kernels:
        """Correlation kernels of a template crop ``(127, 127, 3)``, uint8, BGR."""
        return self._model.template(_as_input(crop))

    @torch.inference_mode()
    def search(self, crop: Image, kernels: Kernels) -> tuple[Float32Array, Float32Array]:
        """Scores ``(N, N)`` and boxes ``(N, N, 4)`` of a search crop ``(S, S, 3)``, uint8, BGR."""
        scores, boxes = self._model.search(_as_input(crop), kernels)
        return scores[0].numpy(), boxes[0].numpy()

    def _warm_up(self) -> None:
        """Run once, so that the first frame costs no more than later ones."""
        z, x = (np.zeros((s, s, 3), np.uint8) for s in (self.spec.template_size, self.spec.search_size))
        self.search(x, self.template(z))


def _as_input(crop: Image) -> torch.Tensor:
    # The permuted view of a HWC image is channels-last in memory, which is what the convolutions want.
    return torch.from_numpy(crop).permute(2, 0, 1)[None].float()
