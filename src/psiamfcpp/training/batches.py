"""Batches of pairs, numbered, so that any of them can be made again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from psiamfcpp.training.pairs import Pair, PairSampler


@dataclass(frozen=True)
class Batch:
    """B pairs as tensors; images stay uint8 until the network takes them."""

    template: Tensor
    """``(B, 127, 127, 3)`` uint8, BGR"""
    search: Tensor
    """``(B, S, S, 3)`` uint8, BGR"""
    corners: Tensor
    """``(B, 4)`` float: x0, y0, x1, y1 in the search crop"""
    present: Tensor
    """``(B,)`` bool"""

    def template_input(self) -> Tensor:
        """``(B, 3, 127, 127)`` float, channels last in memory."""
        return self.template.permute(0, 3, 1, 2).float()

    def search_input(self) -> Tensor:
        """``(B, 3, S, S)`` float, channels last in memory."""
        return self.search.permute(0, 3, 1, 2).float()

    def to(self, device: torch.device) -> Batch:
        """The batch on another device."""
        return Batch(
            *(t.to(device, non_blocking=True) for t in (self.template, self.search, self.corners, self.present))
        )


def collate(pairs: list[Pair]) -> Batch:
    """One batch of the given pairs."""
    return Batch(
        torch.from_numpy(np.stack([p.template for p in pairs])),
        torch.from_numpy(np.stack([p.search for p in pairs])),
        torch.tensor([p.corners for p in pairs], dtype=torch.float32),
        torch.tensor([p.present for p in pairs]),
    )


class _Numbered(Dataset[Pair]):
    """Pairs by number, for the loader's processes."""

    def __init__(self, sampler: PairSampler):
        self._sampler = sampler

    def __getitem__(self, index: int) -> Pair:
        return self._sampler.pair(index)


def numbered_batches(
    sampler: PairSampler, batch: int, start: int, end: int, rank: int = 0, ranks: int = 1, workers: int = 1
) -> Iterator[Batch]:
    """The batches of steps ``start`` to ``end``, this rank's share of each.

    Step ``s`` uses the pairs ``s * batch * ranks`` and up, parted by rank, whatever step the run began at.

    Args:
        sampler: where pairs come from.
        batch: pairs a step and rank.
        start: first step.
        end: step after the last.
        rank: number of this process.
        ranks: number of processes.
        workers: loader processes; 0 loads in this one.
    """
    order = [[(step * ranks + rank) * batch + i for i in range(batch)] for step in range(start, end)]
    yield from DataLoader(
        _Numbered(sampler),
        batch_sampler=order,
        collate_fn=collate,
        num_workers=workers,
        prefetch_factor=4 if workers else None,
        worker_init_fn=_one_thread if workers else None,
        # A forked child can wait for ever on a lock of OpenCV's thread pool.
        multiprocessing_context="spawn" if workers else None,
    )


def _one_thread(_worker: int) -> None:
    import cv2

    # OpenCV would start a thread a core in each loader process, which the network needs.
    cv2.setNumThreads(1)
