"""Crops to look at a network with: pairs drawn as for training, but without changes of colour and cover."""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from psiamfcpp.datasets import Sequence
from psiamfcpp.spec import ModelSpec
from psiamfcpp.training.batches import collate
from psiamfcpp.training.options import PairOptions
from psiamfcpp.training.pairs import PairSampler


def plain_pairs(sequences: list[Sequence], spec: ModelSpec, seed: int) -> PairSampler:
    """Return pairs of a template crop and a search crop as a model of a spec takes them, by number.

    Raises:
        UserError: there is nothing to draw from.
    """
    options = PairOptions(search_size=spec.search_size, augmentation=0.0)
    return PairSampler(sequences, options, seed, cache_bytes=10**9, arch=spec.arch)


def batches(pairs: PairSampler, start: int, end: int, batch: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield pairs ``start`` to ``end`` as the network's forward takes them: templates and search crops, by batch."""
    for first in range(start, end, batch):
        some = collate([pairs.pair(i) for i in range(first, min(first + batch, end))])
        yield some.template_input(), some.search_input()
