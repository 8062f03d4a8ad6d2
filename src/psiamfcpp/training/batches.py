"""Batches of pairs, numbered, so that any of them can be made again."""

from __future__ import annotations

import dataclasses
import pickle
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from psiamfcpp.errors import UserError
from psiamfcpp.files import writing
from psiamfcpp.training.pairs import Pair, PairSampler
from psiamfcpp.training.stored import Said, StoredMaps


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
    side: Tensor
    """``(B,)`` float: root of the target's area in the template's frame, pixels"""
    said: tuple[Tensor, Tensor, Tensor, Tensor] | None = None
    """what a stored teacher says, see `Said`: scores, sides, corners, trust; None without one"""

    def template_input(self) -> Tensor:
        """``(B, 3, 127, 127)`` float, channels last in memory."""
        return self.template.permute(0, 3, 1, 2).float()

    def search_input(self) -> Tensor:
        """``(B, 3, S, S)`` float, channels last in memory."""
        return self.search.permute(0, 3, 1, 2).float()

    def to(self, device: torch.device) -> Batch:
        """The batch on another device."""
        return self._each(lambda tensor: tensor.to(device, non_blocking=True))

    def pin_memory(self) -> Batch:
        """The batch in memory that a GPU can fetch while it computes; the loader calls this."""
        return self._each(Tensor.pin_memory)

    def _each(self, change: Callable[[Tensor], Tensor]) -> Batch:
        said = None if self.said is None else tuple(change(tensor) for tensor in self.said)
        own = change(self.template), change(self.search), change(self.corners), change(self.present), change(self.side)
        return Batch(*own, cast("tuple[Tensor, Tensor, Tensor, Tensor] | None", said))


def collate(pairs: list[Pair], said: list[Said] | None = None) -> Batch:
    """One batch of the given pairs, with what a stored teacher says of them."""
    return Batch(
        torch.from_numpy(np.stack([p.template for p in pairs])),
        torch.from_numpy(np.stack([p.search for p in pairs])),
        torch.tensor([p.corners for p in pairs], dtype=torch.float32),
        torch.tensor([p.present for p in pairs]),
        torch.tensor([p.side for p in pairs], dtype=torch.float32),
        None if said is None else _stacked(said),
    )


def _stacked(said: list[Said]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    scores, sides, corners, trust = (
        torch.from_numpy(np.stack([getattr(s, field.name) for s in said])).float() for field in dataclasses.fields(Said)
    )
    return scores, sides, corners, trust


class _Numbered(Dataset["tuple[Pair, Said | None] | UserError"]):
    """Pairs by number, for the loader's processes.

    A `UserError` is handed over: raised in another process, it would arrive with that process's traceback in its text.

    Processes read the sampler from a file. Through the pipe to a new process, which holds 64 KiB, the next process
    would start only when that one has started and has read all: three seconds for each with large data.
    """

    def __init__(self, sampler: PairSampler, stored: StoredMaps | None, file: Path | None = None):
        self._sampler = sampler
        self._stored = stored
        self._file = file
        if file:
            with writing(file):
                file.write_bytes(pickle.dumps((sampler, stored)))

    def __reduce__(self) -> tuple[Callable[[Path], _Numbered], tuple[Path]]:
        assert self._file, "only a loader without processes has no file"
        return _read_numbered, (self._file,)

    def __getitem__(self, index: int) -> tuple[Pair, Said | None] | UserError:
        try:
            return self._sampler.pair(index), None if self._stored is None else self._stored.get(index)
        except UserError as error:
            return error


def _read_numbered(file: Path) -> _Numbered:
    return _Numbered(*pickle.loads(file.read_bytes()))


def _collated(samples: list[tuple[Pair, Said | None] | UserError]) -> Batch | UserError:
    whole = [sample for sample in samples if not isinstance(sample, UserError)]
    if len(whole) < len(samples):
        return next(sample for sample in samples if isinstance(sample, UserError))
    said = [s for _, s in whole if s is not None]
    return collate([pair for pair, _ in whole], said or None)


def numbered_batches(
    sampler: PairSampler,
    batch: int,
    start: int,
    end: int,
    rank: int = 0,
    ranks: int = 1,
    workers: int = 1,
    stored: StoredMaps | None = None,
) -> Iterator[Batch]:
    """The batches of steps ``start`` to ``end``, this rank's share of each.

    Step ``s`` uses the pairs ``s * batch * ranks`` and up, divided by rank, whatever step the run began at.

    Args:
        sampler: where pairs come from.
        batch: pairs a step and rank.
        start: first step.
        end: step after the last.
        rank: number of this process.
        ranks: number of processes.
        workers: loader processes; 0 loads in this one.
        stored: what a teacher says of the pairs.

    Raises:
        UserError: an image cannot be read.
    """
    order = [[(step * ranks + rank) * batch + i for i in range(batch)] for step in range(start, end)]
    with tempfile.TemporaryDirectory(prefix="psiamfcpp-pairs-") as folder:
        loader = DataLoader(
            _Numbered(sampler, stored, Path(folder, "sampler") if workers else None),
            batch_sampler=order,
            collate_fn=_collated,
            num_workers=workers,
            prefetch_factor=4 if workers else None,
            pin_memory=torch.cuda.is_available(),
            worker_init_fn=_one_thread if workers else None,
            # A forked child can wait for ever on a lock of OpenCV's thread pool.
            multiprocessing_context="spawn" if workers else None,
        )
        for found in loader:
            if isinstance(found, UserError):
                raise found
            yield found


def _one_thread(_worker: int) -> None:
    import cv2

    # OpenCV would start one thread per core in each loader process, which the network needs.
    cv2.setNumThreads(1)
