"""Which filters can only go together, and whose maps speak for them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn

from psiamfcpp.errors import UserError


@dataclass(frozen=True)
class Group:
    """Layers whose outputs are tied channel by channel: filter i of one goes with filter i of all others."""

    blocks: tuple[str, ...]
    """names of the modules whose output is a map of the group; each holds one convolution"""
    width: int
    """number of filters"""
    parts: int = 1
    """number of blocks into which grouped convolutions divide the channels; each must keep the same positions"""
    views: tuple[str, ...] = ()
    """names of the group's maps in the order in which a forward pass makes them, where they have names"""
    name: str = ""
    """name in plans and tables; by default that of the first block"""
    others: tuple[str, ...] = field(default=(), compare=False)
    """names of further modules that lose the same filters, whose maps do not speak for them, where they are known"""
    readers: tuple[str, ...] = field(default=(), compare=False)
    """names of the layers that lose inputs with the group's filters, where they are known"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or self.blocks[0])

    def __str__(self) -> str:
        """Return one line: name, filters, what is tied, what reads them."""
        parts = [f"{self.name}: {self.width} filters"]
        if len(self.blocks) + len(self.others) > 1:
            parts.append("tied in " + ", ".join((*self.others, *self.blocks)))
        elif self.blocks[0] != self.name:
            parts.append(f"of {self.blocks[0]}")
        if self.parts > 1:
            parts.append(f"the same positions in each of {self.parts} parts")
        if self.readers:
            parts.append("read by " + ", ".join(self.readers))
        return "; ".join(parts)


def find_groups(model: nn.Module, example_inputs: Any) -> dict[str, Group]:
    """The groups of any network, by torch-pruning's dependency graph.

    A group is named after the first of its convolutions. Groups that reach the network's outputs are left out, since
    pruning them would change the shape of what it returns.

    Args:
        model: the network.
        example_inputs: what its forward takes: a tensor, or a tuple of arguments.

    Raises:
        UserError: the network cannot be traced.
    """
    graph = dependency_graph(model, example_inputs)
    names = {module: name for name, module in model.named_modules()}
    order = {name: number for number, name in enumerate(names.values())}
    groups = {}
    for tied in graph.get_all_groups(root_module_types=[nn.Conv2d]):
        if any(type(dependency.target.module).__name__ == "_OutputOp" for dependency, _ in tied):
            continue
        made = [d.target.module for d, _ in tied if graph.is_out_channel_pruning_fn(d.handler)]
        convolutions = sorted(
            {names[m] for m in made if isinstance(m, nn.Conv2d) and m in names}, key=order.__getitem__
        )
        first = model.get_submodule(convolutions[0])
        assert isinstance(first, nn.Conv2d)
        parts = max(_parts(dependency.target.module) for dependency, _ in tied)
        reading = {
            names[d.target.module]
            for d, _ in tied
            if graph.is_in_channel_pruning_fn(d.handler) and d.target.module in names and d.target.module not in made
        }
        readers = tuple(sorted(reading, key=order.__getitem__))
        groups[convolutions[0]] = Group(tuple(convolutions), first.out_channels, parts, readers=readers)
    return dict(sorted(groups.items(), key=lambda item: order[item[0]]))


def dependency_graph(model: nn.Module, example_inputs: Any) -> Any:
    """Return torch-pruning's dependency graph of a network, traced in evaluation mode with gradients on.

    Raises:
        UserError: the network cannot be traced, as always in `torch.inference_mode`.
    """
    import warnings

    import torch_pruning

    if torch.is_inference_mode_enabled():
        raise UserError("a network is traced by its gradients, which torch.inference_mode() forbids: leave that mode")
    wanted = {name: parameter.requires_grad for name, parameter in model.named_parameters()}
    modes = {module: module.training for module in model.modules()}
    try:
        model.eval().requires_grad_(True)
        with warnings.catch_warnings(), torch.enable_grad():
            warnings.simplefilter("ignore")
            inputs = example_inputs if isinstance(example_inputs, (tuple, list, dict)) else (example_inputs,)
            return torch_pruning.DependencyGraph().build_dependency(
                model, inputs, output_transform=_marked, verbose=False
            )
    except Exception as error:  # a foreign network can fail in any way
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"torch-pruning cannot trace the network: {reason}") from None
    finally:
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(wanted[name])
        for module, training in modes.items():
            module.training = training


def convolution_of(model: nn.Module, block: str) -> nn.Conv2d:
    """The first convolution in a module of the network.

    Raises:
        UserError: there is no such module, or no convolution in it.
    """
    try:
        module = model.get_submodule(block)
    except AttributeError:
        raise UserError(f"the network has no module {block!r}: name one of its layers") from None
    found = next((m for m in module.modules() if isinstance(m, nn.Conv2d)), None)
    if found is None:
        raise UserError(f"module {block!r} holds no convolution: name a layer with filters")
    return found


def _marked(outputs: Any) -> list[torch.Tensor]:
    """The outputs after one more operation each, by which torch-pruning finds where a network ends."""
    if isinstance(outputs, torch.Tensor):
        return [outputs * 1] if outputs.requires_grad else []
    if isinstance(outputs, dict):
        outputs = outputs.values()
    return [marked for part in outputs for marked in _marked(part)] if isinstance(outputs, Iterable) else []


def _parts(module: nn.Module) -> int:
    """Number of blocks into which a module divides its channels; 1 for a depthwise convolution, which ties none."""
    if isinstance(module, nn.Conv2d):
        return 1 if module.groups == module.out_channels else module.groups
    return module.num_groups if isinstance(module, nn.GroupNorm) else 1
