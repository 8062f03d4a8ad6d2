"""What the layers of a network read in a forward pass, as the columns of a least-squares fit."""

from __future__ import annotations

from typing import Any

import torch.nn.functional as F
from torch import Tensor, nn

Layer = nn.Conv2d | nn.Linear

# Against the mean square of a layer's inputs: how strongly weights are held to what they were.
RIDGE = 1e-3


class PassedError(Exception):
    """A forward pass has come through the layers that are looked at: what follows is of no use."""


def layers_of(model: nn.Module) -> list[tuple[str, Layer]]:
    """What can be fitted."""
    return [(name, module) for name, module in model.named_modules() if isinstance(module, (nn.Conv2d, nn.Linear))]


def calls_of(model: nn.Module, example: Any) -> dict[str, int]:
    """How often a forward pass calls each layer, in the order of the first calls."""
    calls: dict[str, int] = {}

    def called(name: str) -> None:
        calls[name] = calls.get(name, 0) + 1

    hooks = [layer.register_forward_hook(lambda *_, name=name: called(name)) for name, layer in layers_of(model)]
    try:
        run(model, example)
    finally:
        for hook in hooks:
            hook.remove()
    return calls


def rows_of(layer: Layer, x: Tensor) -> Tensor:
    """What the weights of a filter are multiplied by: ``(groups, weights, positions)``, with ones for the bias."""
    if isinstance(layer, nn.Conv2d):
        mode = "constant" if layer.padding_mode == "zeros" else layer.padding_mode
        x = F.pad(x, layer._reversed_padding_repeated_twice, mode)
        x = F.unfold(x, layer.kernel_size, layer.dilation, 0, layer.stride).transpose(0, 1)
        rows = x.reshape(layer.groups, len(x) // layer.groups, -1)
    else:
        rows = x.reshape(1, -1, layer.in_features).mT
    return F.pad(rows, (0, 0, 0, 1), value=1.0) if layer.bias is not None else rows


def inputs_of(model: nn.Module, calls: dict[str, int], batch: Any) -> list[tuple[str, Tensor]]:
    """What layers read in a forward pass, call by call; it ends when all of their calls were seen.

    Args:
        model: the network.
        calls: how often a pass calls each of the layers.
        batch: what its forward takes.
    """
    found: list[tuple[str, Tensor]] = []

    def called(name: str, x: Tensor) -> None:
        # a copy, since what comes next may write into it
        found.append((name, x.clone()))
        if len(found) == sum(calls.values()):
            raise PassedError

    hooks = [
        model.get_submodule(name).register_forward_hook(lambda _m, inputs, _o, name=name: called(name, inputs[0]))
        for name in calls
    ]
    try:
        run(model, batch)
    except PassedError:
        pass
    finally:
        for hook in hooks:
            hook.remove()
    return found


def run(model: nn.Module, batch: Any) -> None:
    """Run a network on what its forward takes, as one argument or as several."""
    model(*batch) if isinstance(batch, (tuple, list)) else model(batch)
