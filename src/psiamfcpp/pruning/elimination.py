"""What it costs to remove channels, when the layers that read them are fitted anew by least squares.

A layer puts out ``W x`` for inputs ``x`` with second moments ``H = mean(x x')``; let ``P`` be the inverse of ``H``.
Without the inputs ``S`` the best fit is ``W - W_S inv(P_SS) P_S:``, with a mean square error of
``tr(W_S inv(P_SS) W_S')``. Then ``P - P_:S inv(P_SS) P_S:`` is the inverse for what is left, and the next inputs can
go. This is Optimal Brain Surgeon (Hassibi and Stork 1993), exact for the square error of one layer; for several inputs
at once see Kurtic et al. 2023 (ZipLM).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from psiamfcpp.errors import UserError
from psiamfcpp.pruning.reading import RIDGE, Layer, calls_of, inputs_of, rows_of

# Positions of each map that moments are taken over: neighbours say much the same.
_POSITIONS = 256


@dataclass
class Fit:
    """A least-squares fit from which inputs are removed one unit after the other."""

    inverse: Tensor
    """``(K, K)``: inverse of the second moments, inputs scaled to a mean square of 1"""
    weight: Tensor
    """``(K, outputs)``: the best weights for what is left"""
    units: list[Tensor]
    """for each unit, the inputs that go with it; none for one that the layer does not read"""

    @classmethod
    def of(cls, square: Tensor, weight: Tensor, units: list[Tensor]) -> Fit:
        """Return the fit of a layer that reads everything.

        Args:
            square: ``(K, K)`` second moments of the inputs.
            weight: ``(outputs, K)``, divided by what errors are to be measured against.
            units: for each unit, the inputs that go with it.
        """
        scale = square.diagonal().clamp(min=0).sqrt()
        # An input that is always 0 costs nothing, whatever its weight.
        inner = torch.where(scale > 0, 1 / scale, torch.zeros_like(scale))
        correlation = square * inner * inner[:, None]
        correlation.diagonal().copy_(torch.full_like(scale, 1 + RIDGE))
        return cls(torch.cholesky_inverse(torch.linalg.cholesky(correlation)), (weight * scale).mT.clone(), units)

    def costs(self, left: Sequence[int]) -> Tensor:
        """Return what the removal of each of the units left would add to the error, ``(len(left),)``."""
        found = torch.zeros(len(left), dtype=self.weight.dtype)
        sizes: dict[int, list[int]] = {}
        for place, unit in enumerate(left):
            sizes.setdefault(len(self.units[unit]), []).append(place)
        for size, places in sizes.items():
            if size:
                inputs = torch.stack([self.units[left[place]] for place in places])
                block = self.inverse[inputs[:, :, None], inputs[:, None, :]]
                weight = self.weight[inputs]
                found[places] = (weight * torch.linalg.solve(block, weight)).sum(dim=(1, 2))
        return found

    def remove(self, unit: int) -> None:
        """Remove the inputs of a unit, and fit the weights of the others anew."""
        inputs = self.units[unit]
        if not len(inputs):
            return
        across = self.inverse[:, inputs]
        share = torch.linalg.solve(self.inverse[inputs[:, None], inputs], across.mT)
        self.weight -= share.mT @ self.weight[inputs]
        self.inverse -= across @ share

    def shrink(self, left: Sequence[int]) -> None:
        """Drop the inputs of all units but those left, which have been removed."""
        gone = torch.zeros(len(self.weight), dtype=torch.bool)
        for unit in set(range(len(self.units))).difference(left):
            gone[self.units[unit]] = True
            self.units[unit] = self.units[unit][:0]
        place = (~gone).cumsum(0) - 1
        self.inverse, self.weight = self.inverse[~gone][:, ~gone], self.weight[~gone]
        self.units = [place[inputs] for inputs in self.units]


def eliminate(fits: list[Fit], units: int) -> Tensor:
    """Remove all units greedily, each time the one that adds least to the sum of the fits' errors.

    Returns:
        ``(units,)``: the error reached with the removal of each unit, which rises in the order of removal.
    """
    reached, error = torch.zeros(units, dtype=torch.float64), 0.0
    left = list(range(units))
    size = units
    while left:
        if len(left) < 0.85 * size:
            size = len(left)
            for fit in fits:
                fit.shrink(left)
        costs = torch.stack([fit.costs(left) for fit in fits]).sum(dim=0).clamp(min=0)
        cheapest = int(costs.argmin())
        error += float(costs[cheapest])
        unit = left.pop(cheapest)
        reached[unit] = error
        for fit in fits:
            fit.remove(unit)
    return reached


@torch.no_grad()
def fits_of(model: nn.Module, readers: dict[str, dict[int, int]], units: int, batches: Sequence[Any]) -> list[Fit]:
    """Return the fits of layers that read a group's filters; errors are shares of the variance of a layer's outputs.

    Args:
        model: the network, in evaluation mode.
        readers: by name of a layer, the unit of each of its inputs that belongs to one.
        units: number of units.
        batches: what the network's forward takes.
    """
    layers = {name: _reader(model, name) for name in readers}
    squares = _moments(model, layers, batches)
    found = []
    for name, layer in layers.items():
        groups = layer.groups if isinstance(layer, nn.Conv2d) else 1
        inputs = (layer.in_channels if isinstance(layer, nn.Conv2d) else layer.in_features) // groups
        weights = layer.weight.double().reshape(groups, len(layer.weight) // groups, -1)
        area = weights.shape[2] // inputs
        variance = float(torch.einsum("gok,gkl,gol->", weights, squares[name], weights))
        for group in range(groups):
            own: list[list[int]] = [[] for _ in range(units)]
            for channel, unit in readers[name].items():
                if channel // inputs == group:
                    first = channel % inputs * area
                    own[unit] += range(first, first + area)
            weight = weights[group] / max(variance, 1e-30) ** 0.5
            found.append(Fit.of(squares[name][group], weight, [torch.tensor(columns).long() for columns in own]))
    return found


def _reader(model: nn.Module, name: str) -> Layer:
    layer = model.get_submodule(name)
    if not isinstance(layer, (nn.Conv2d, nn.Linear)):
        raise UserError(f"{name} is a {type(layer).__name__}, which cannot be fitted: choose by another criterion")
    return layer


def _moments(model: nn.Module, layers: dict[str, Layer], batches: Sequence[Any]) -> dict[str, Tensor]:
    """Second moments ``(groups, K, K)`` of what layers read, about the mean for those with a bias.

    Each call of a layer counts alike, however large its maps, so that a template counts as much as a search crop.
    """
    generator = torch.Generator().manual_seed(0)
    sums: dict[str, Tensor] = {}
    origins: dict[str, Tensor] = {}
    weights: dict[str, int] = {}

    def seen(name: str, layer: Layer, x: Tensor) -> None:
        rows = rows_of(layer, x)
        share = min(1.0, _POSITIONS * len(x) / rows.shape[2])
        chosen = torch.randperm(rows.shape[2], generator=generator)[: max(1, round(share * rows.shape[2]))]
        rows = rows[:, :, chosen.to(rows.device)]
        if layer.bias is not None:
            # About a point near the mean, since float32 would lose a small variance beside a large mean.
            if name not in origins:
                origins[name] = rows.mean(dim=2, keepdim=True)
                origins[name][:, -1] = 0
            rows = rows - origins[name]
        sums[name] = sums.get(name, 0) + (rows @ rows.mT).double().cpu() * (len(x) / rows.shape[2])
        weights[name] = weights.get(name, 0) + len(x)

    calls = calls_of(model, batches[0])
    unseen = [name for name in layers if name not in calls]
    if unseen:
        raise UserError(f"no forward pass came through {', '.join(unseen)}: give other inputs")
    for batch in batches:
        for name, x in inputs_of(model, {name: calls[name] for name in layers}, batch):
            seen(name, layers[name], x)
    means = {name: value / weights[name] for name, value in sums.items()}
    return {name: _centred(value, origins[name]) if name in origins else value for name, value in means.items()}


def _centred(square: Tensor, origin: Tensor) -> Tensor:
    """Second moments about the mean, from those about an origin with a row of ones at the end."""
    mean = square[:, -1:, :-1]
    centred = square[:, :-1, :-1] - mean.mT @ mean
    # What varies by no more than float32's rounding does not vary.
    size = (mean + origin.cpu().double().mT[:, :, :-1]).square()
    varies = (centred.diagonal(dim1=1, dim2=2)[:, None] > 1e-10 * size).double()
    return centred * varies * varies.mT
