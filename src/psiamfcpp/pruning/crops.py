"""Crops to look at a network with: pairs drawn as for training, but without changes of colour and cover."""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from psiamfcpp.datasets import Sequence
from psiamfcpp.training.batches import collate
from psiamfcpp.training.options import PairOptions
from psiamfcpp.training.pairs import PairSampler


def plain_pairs(sequences: list[Sequence], search_size: int, seed: int) -> PairSampler:
    """Pairs of a template crop and a search crop of so many pixels, by number.

    Raises:
        UserError: there is nothing to draw from.
    """
    return PairSampler(sequences, PairOptions(search_size=search_size, augmentation=0.0), seed, cache_bytes=10**9)


def batches(pairs: PairSampler, start: int, end: int, batch: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Pairs ``start`` to ``end`` as what the network's forward takes: templates and search crops, so many at a time."""
    for first in range(start, end, batch):
        some = collate([pairs.pair(i) for i in range(first, min(first + batch, end))])
        yield some.template_input(), some.search_input()
