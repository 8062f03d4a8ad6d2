"""Start of a backbone from torchvision's AlexNet features, widened to the widths of SiamFC++."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor

from psiamfcpp.errors import UserError, brief
from psiamfcpp.files import check_file
from psiamfcpp.models.network import SiamFCpp

# torchvision's preprocessing: RGB in 0..1, minus mean, over standard deviation.
_MEAN = torch.tensor([0.485, 0.456, 0.406])
_STD = torch.tensor([0.229, 0.224, 0.225])

# Index of each convolution in torchvision's `features`, with its published width.
_LAYERS = {"conv1": (0, 64), "conv2": (3, 192), "conv3": (6, 384), "conv4": (8, 256), "conv5": (10, 256)}
# Share of a filter's spread that is added as noise to its copy, without which both would learn the same.
_COPY_NOISE = 0.1


def is_alexnet(path: Path) -> bool:
    """Whether a safetensors file holds torchvision's AlexNet features.

    Raises:
        UserError: the file cannot be read.
    """
    check_file(path, "weights", "give a .safetensors file")
    try:
        with safe_open(str(path), framework="pt") as file:
            return "features.0.weight" in file.keys()  # noqa: SIM118 - not a dict
    except Exception as error:  # a damaged file can fail in any way
        raise UserError(f"weights {path} cannot be read ({brief(error)}): give a .safetensors file") from None


def init_backbone(model: SiamFCpp, path: Path, seed: int = 0) -> None:
    """Fill the backbone from a torchvision AlexNet file so that it computes that network's features.

    conv1 takes BGR 0..255 (channel order, scale, mean and deviation are folded into its weights) and keeps its 11x11
    kernel at stride 2. Widened channels are noisy copies of existing ones (Net2Net, Chen et al. 2016): what reads
    them shares its weight, unevenly, between original and copy, so that the function stays nearly the same while
    the two get different gradients. BatchNorm starts as the identity.

    Args:
        model: network with backbone widths at least AlexNet's.
        path: safetensors with ``features.N.weight`` and ``features.N.bias``.
        seed: of the copies' noise.

    Raises:
        UserError: the file is damaged, lacks a tensor, has one of another shape, or is wider than the network.
    """
    try:
        weights = load_file(str(path))
    except Exception as error:  # a damaged file can fail in any way
        raise UserError(f"AlexNet weights {path} cannot be read: {brief(error)}") from None
    generator = torch.Generator().manual_seed(seed)
    inputs, sources, shares = 3, torch.arange(3), torch.ones(3)
    for name, (index, published) in _LAYERS.items():
        block = getattr(model.backbone, name)
        try:
            weight, bias = weights[f"features.{index}.weight"], weights[f"features.{index}.bias"]
        except KeyError as error:
            raise UserError(f"AlexNet weights {path} lack {error}: expected torchvision's features") from None
        expected = (published, inputs, *block.conv.kernel_size)
        if weight.shape != expected or bias.shape != expected[:1] or published > block.conv.out_channels:
            raise UserError(
                f"{name} of {path} is {tuple(weight.shape)} with {bias.numel()} biases: expected {expected}, "
                f"of at most {block.conv.out_channels} filters"
            )
        if not all(value.is_floating_point() and torch.isfinite(value.float()).all() for value in (weight, bias)):
            raise UserError(f"{name} of {path} holds values that are no finite numbers: fetch the file again")
        weight, bias, inputs = weight.float(), bias.float(), published
        if name == "conv1":
            weight, bias = fold_preprocessing(weight, bias)
        weight = weight[:, sources] * shares[None, :, None, None]
        sources, shares = _widen(len(weight), block.conv.out_channels, generator)
        weight, bias = weight[sources], bias[sources].clone()
        spread = weight.flatten(1).std(dim=1)[:, None, None, None]
        noise = torch.randn(weight.shape, generator=generator)
        noise[:published] = 0
        weight = weight + _COPY_NOISE * spread * noise
        with torch.no_grad():
            block.conv.weight.copy_(weight)
            block.conv.bias.copy_(bias)


def fold_preprocessing(weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
    """Return weight and bias of a first layer for BGR, 0..255, from those for RGB as torchvision normalises it."""
    bias = bias - (weight * (_MEAN / _STD)[None, :, None, None]).sum(dim=(1, 2, 3))
    return (weight / (255 * _STD)[None, :, None, None]).flip(1), bias


def _widen(width: int, target: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """For each of ``target`` channels: the channel it repeats, and its share of what reads that channel."""
    extra = torch.randperm(width, generator=generator)[: target - width]
    sources = torch.cat([torch.arange(width), extra])
    if len(sources) < target:
        raise UserError(f"cannot widen {width} filters to {target}: at most twice as many")
    shares = torch.ones(target)
    split = 0.3 + 0.4 * torch.rand(len(extra), generator=generator)
    shares[width:] = split
    shares[extra] = 1 - split
    return sources, shares
