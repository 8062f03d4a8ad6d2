"""The torch engine: runs a checkpoint as it is, in float32 on the processor and in half precision on a GPU."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.machine import usable_cores
from psiamfcpp.models import load
from psiamfcpp.models.network import ConvBlock, Network
from psiamfcpp.runtime.device import CPU, Device
from psiamfcpp.runtime.engine import Float32Array, Images, resized, warm_up

Kernels = tuple[Tensor, ...]


class TorchEngine:
    """See `psiamfcpp.runtime.engine.Engine`.

    Args:
        model: name or path of a checkpoint, or a network in evaluation mode.
        threads: threads of the whole process on the processor; by default one for each usable core.
        search_size: side of the search crop in pixels; by default the model's own.
        device: the processor, or a GPU on CUDA.

    Raises:
        UserError: no such checkpoint, or torch cannot compute on the device.
    """

    name = "torch"

    def __init__(
        self,
        model: str | Network,
        threads: int | None = None,
        search_size: int | None = None,
        device: Device = CPU,
    ):
        self._place = torch_device(device)
        network = load(model) if isinstance(model, str) else model
        self.device = str(device)
        self._half = device.kind == "cuda"
        self.precision = "fp16" if self._half else "fp32"
        self._model = in_half(network) if self._half else network
        self._model.to(self._place, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.spec = resized(network.spec, search_size)
        torch.set_num_threads(threads or usable_cores())
        warm_up(self)

    @torch.inference_mode()
    def template(self, crop: Image) -> Kernels:
        """Return what `search` needs of a template crop ``(Z, Z, 3)``, uint8, BGR."""
        with self._autocast():
            return self._model.template(self._as_input(crop))

    @torch.inference_mode()
    def search(self, crop: Image, kernels: Kernels) -> tuple[Float32Array, Float32Array]:
        """Return scores ``(N, N)`` and boxes ``(N, N, 4)`` of a search crop ``(S, S, 3)``, uint8, BGR."""
        with self._autocast():
            scores, boxes = self._model.search(self._as_input(crop), kernels)
        return _as_array(scores[0]), _as_array(boxes[0])

    @torch.inference_mode()
    def search_many(self, crops: Images, kernels: list[Kernels]) -> tuple[Float32Array, Float32Array]:
        """Return scores ``(B, N, N)`` and boxes ``(B, N, N, 4)`` of crops ``(B, S, S, 3)``, uint8, BGR."""
        joined = tuple(torch.cat(part) for part in zip(*kernels, strict=True))
        with self._autocast():
            scores, boxes = self._model.search(self._moved(torch.from_numpy(crops).permute(0, 3, 1, 2)), joined)
        return _as_array(scores), _as_array(boxes)

    def _autocast(self) -> Any:
        return torch.autocast(self._place.type, torch.float16, enabled=self._half)

    def _as_input(self, crop: Image) -> Tensor:
        # The permuted view of a HWC image is channels-last in memory, which is what the convolutions want.
        return self._moved(torch.from_numpy(crop).permute(2, 0, 1)[None])

    def _moved(self, images: Tensor) -> Tensor:
        # Bytes are copied to the GPU and become floats there: a quarter of the copy.
        return images.to(self._place).float()


def torch_device(device: Device) -> torch.device:
    """Return torch's own description of a device.

    Raises:
        UserError: torch was built without CUDA, finds no GPU, or not the one with this number.
    """
    if device.kind == "cpu":
        return torch.device("cpu")
    if not torch.cuda.is_available():
        if torch.version.cuda is None:
            raise UserError(
                f"device {device}: the installed torch {torch.__version__} is built without CUDA: "
                "pip uninstall -y torch, then install a CUDA build (https://pytorch.org/get-started/locally)"
            )
        raise UserError(f"device {device}: torch finds no GPU: check the driver with nvidia-smi")
    count = torch.cuda.device_count()
    if device.index >= count:
        raise UserError(f"device {device}: torch finds {count} of them, numbered from 0")
    return torch.device("cuda", device.index)


def in_half(network: Network) -> Network:
    """Return a copy of a network whose convolutions have weights in half precision, for use under autocast.

    BatchNorm is folded into them before, in float32: variances of maps of grey levels exceed half precision's range.
    """
    found = copy.deepcopy(network)
    for module in found.modules():
        if isinstance(module, ConvBlock) and module.bn is not None:
            module.conv, module.bn = fuse_conv_bn_eval(module.conv, module.bn), None
    for module in found.modules():
        if isinstance(module, nn.Conv2d):
            module.half()
    return found


def _as_array(result: Tensor) -> Float32Array:
    array: Float32Array = result.float().cpu().numpy()
    return array
