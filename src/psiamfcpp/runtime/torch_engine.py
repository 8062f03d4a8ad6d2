"""The torch engine: runs a checkpoint as it is, in float32."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from psiamfcpp.geometry import Image
from psiamfcpp.models import SiamFCpp, load
from psiamfcpp.models.network import Kernels
from psiamfcpp.runtime.engine import Float32Array, Images, usable_cores


class TorchEngine:
    """See `psiamfcpp.runtime.engine.Engine`."""

    def __init__(self, model: str | SiamFCpp, threads: int | None = None, search_size: int | None = None):
        self._model = load(model) if isinstance(model, str) else model
        self._model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.spec = self._model.spec
        if search_size is not None:
            self.spec = dataclasses.replace(self.spec, search_size=search_size)
        torch.set_num_threads(threads or usable_cores())
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

    @torch.inference_mode()
    def search_many(self, crops: Images, kernels: list[Kernels]) -> tuple[Float32Array, Float32Array]:
        """Scores ``(B, N, N)`` and boxes ``(B, N, N, 4)`` of crops ``(B, S, S, 3)``, uint8, BGR."""
        cls, reg = (torch.cat(part) for part in zip(*kernels, strict=True))
        scores, boxes = self._model.search(torch.from_numpy(crops).permute(0, 3, 1, 2).float(), (cls, reg))
        return scores.numpy(), boxes.numpy()

    def _warm_up(self) -> None:
        """Run once, so that the first frame costs no more than later ones."""
        z, x = (np.zeros((s, s, 3), np.uint8) for s in (self.spec.template_size, self.spec.search_size))
        self.search(x, self.template(z))


def _as_input(crop: Image) -> torch.Tensor:
    # The permuted view of a HWC image is channels-last in memory, which is what the convolutions want.
    return torch.from_numpy(crop).permute(2, 0, 1)[None].float()
