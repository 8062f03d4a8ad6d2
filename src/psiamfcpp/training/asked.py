"""What LightFC says of a batch, computed in every step: for a GPU, where that costs less than storing it beforehand."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from psiamfcpp.errors import UserError
from psiamfcpp.models import load
from psiamfcpp.models.network import Network
from psiamfcpp.training.batches import Batch
from psiamfcpp.training.lightfc import overlap
from psiamfcpp.training.stored import CELLS, LEAST_OVERLAP, REGION, SMALLEST_SIDE, TEMPLATE, window

Ask = Callable[[Batch], Batch]


def open_asked(path: str | Path, device: torch.device) -> Ask:
    """A function that adds to a batch what a LightFC says of it; its `Batch.said` is like that of `stored.say`.

    Raises:
        UserError: no such model, or it is no LightFC.
    """
    model = load(path)
    if model.spec.architecture != "lightfc":
        raise UserError(f"stored {path} is of architecture {model.spec.architecture}: give a LightFC, or a folder")
    model.to(device).eval().requires_grad_(False)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return functools.partial(ask, model)


@torch.no_grad()
def ask(model: Network, batch: Batch) -> Batch:
    """Return a batch with what a LightFC says of it.

    Regions, box and trust are those of `psiamfcpp.training.stored.say`. Crops are not rounded to whole grey levels.
    """
    size = batch.search.shape[1]
    width, height = (batch.corners[:, 2:] - batch.corners[:, :2] + 1).unbind(dim=1)
    around = (width + height) / 2
    # As `say`: side of the target in a crop without jitter.
    side = batch.template.shape[1] * (width * height / ((width + around) * (height + around))).sqrt()
    kernels = model.template(_middle(batch.template_input(), 2 * side, TEMPLATE))
    maps = model.maps(model.features(_middle(batch.search_input(), 4 * side, REGION)), kernels)
    score = maps[0].squeeze(1)
    weights = torch.as_tensor(window(), dtype=score.dtype, device=score.device)
    best = (score * weights).flatten(1).argmax(dim=1)
    share, offset = (_at(kind, best) for kind in maps[1:])
    cell = torch.stack([best % CELLS, best // CELLS], dim=1)
    place = (cell + offset) / CELLS * 4 * side[:, None] + (size - 1) / 2 - 2 * side[:, None]
    half = share * 2 * side[:, None]
    corners = torch.cat([place - half, place + half], dim=1)
    agrees = batch.present & (batch.side >= SMALLEST_SIDE) & (overlap(corners, batch.corners) >= LEAST_OVERLAP)
    trust = score.flatten(1).gather(1, best[:, None])[:, 0] * agrees
    return dataclasses.replace(batch, said=(score, 4 * side, corners, trust))


def _at(maps: Tensor, cells: Tensor) -> Tensor:
    """Values ``(B, C)`` of maps ``(B, C, N, N)`` at a cell of each."""
    flat = maps.flatten(2)
    return flat.gather(2, cells[:, None, None].expand(-1, flat.shape[1], 1))[..., 0]


def _middle(crops: Tensor, side: Tensor, size: int) -> Tensor:
    """The squares of N pixels ``(B,)`` about the middle of crops ``(B, 3, S, S)``, resized; black outside."""
    line = torch.linspace(-1, 1, size, device=crops.device) * (size - 1) / size
    reach = side / (crops.shape[-1] - 1)
    x = (line[None] * reach[:, None])[:, None, :].expand(-1, size, -1)
    grid = torch.stack([x, x.transpose(1, 2)], dim=-1)
    return F.grid_sample(crops, grid, padding_mode="zeros", align_corners=True)
