"""Score a model's filters by any criterion, as a table to plan with."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence as Several
from pathlib import Path

from torch import Tensor

from psiamfcpp.datasets import Sequence
from psiamfcpp.datasets.choice import HELD_OUT_EVERY, DataChoice
from psiamfcpp.errors import UserError
from psiamfcpp.models import Network, load
from psiamfcpp.pruning.criteria import (
    WITH_LOSS,
    WITH_MAPS,
    Context,
    Criterion,
    find_criterion,
    gradients_of,
    score_table,
)
from psiamfcpp.pruning.models import example_inputs, groups_of
from psiamfcpp.pruning.table import RankTable
from psiamfcpp.recipes.fit_crops import batches, plain_pairs
from psiamfcpp.training.loop import PairLoss
from psiamfcpp.training.options import PairOptions, TrainOptions
from psiamfcpp.training.validation import held_out_batches

_BATCHES = 8
# Pairs of a batch whose maps are looked at.
_PAIRS = 4


def score_model(
    model: str | Path | Network,
    criterion: str | Criterion = "rank",
    *,
    ranks: str | Path | None = None,
    data: Several[str] = (),
    images: int = 100,
    seed: int = 0,
    held_out_every: int = HELD_OUT_EVERY,
) -> RankTable:
    """Score the filters of a model by a criterion.

    Args:
        model: name of a shipped model, a model file, or a network.
        criterion: a name of `psiamfcpp.pruning.CRITERIA`, ``MODULE:FUNCTION``, or a function
            ``f(group, context) -> scores (n,)``.
        ranks: the model's rank table, for criteria that use it.
        data: sets, each LAYOUT:FOLDER, to run the training loss backward on, for criteria that use gradients, or to
            draw crops from, for those that look at maps.
        images: pairs of crops for criteria that look at maps, drawn as by `psiamfcpp.recipes.rank.rank`.
        seed: of that draw.
        held_out_every: the N of training: one clip in N is not drawn from; 0 draws from all.

    Returns:
        The scores in the form of a rank table; `psiamfcpp.recipes.plan.plan` takes it.

    Raises:
        UserError: a file cannot be read, the rank table is of other widths, or the criterion lacks what it needs.
    """
    network = model if isinstance(model, Network) else load(model)
    function = find_criterion(criterion) if isinstance(criterion, str) else criterion
    context = Context(network, example_inputs(network.spec), read_ranks(Path(ranks), network) if ranks else None)
    sequences = DataChoice(tuple(data), held_out_every).training if data else []
    # A function of the user's may look at both.
    if sequences and criterion not in WITH_MAPS:
        options = TrainOptions(pairs=PairOptions(search_size=network.spec.search_size))
        context = dataclasses.replace(context, gradients=loss_gradients(network, sequences, options))
    if sequences and criterion not in WITH_LOSS:
        pairs = plain_pairs(sequences, network.spec, seed)
        context = dataclasses.replace(context, batches=list(batches(pairs, 0, images, _PAIRS)))
    table = score_table(groups_of(network.spec), context, function)
    about = {
        "criterion": criterion if isinstance(criterion, str) else criterion.__name__,
        "architecture": network.spec.architecture,
        "search_size": network.spec.search_size,
    }
    return dataclasses.replace(table, about=about)


def read_ranks(path: Path, network: Network) -> RankTable:
    """Return the rank table in a file.

    Raises:
        UserError: the file cannot be read, or its table is not of a network of these widths.
    """
    table = RankTable.read(path)
    if table.widths != network.spec.widths:
        raise UserError(f"rank table {path} is not of this model, whose widths differ: rank the model itself")
    return table


def loss_gradients(network: Network, sequences: list[Sequence], options: TrainOptions) -> dict[str, Tensor] | None:
    """Return the gradient of the training loss for each parameter, summed over a few fixed batches of pairs.

    Args:
        network: its own gradients are emptied.
        sequences: to draw pairs from.
        options: losses, pairs and batch of training.
    """
    network.zero_grad()
    loss = PairLoss(network, options.losses)
    drawn = held_out_batches(sequences, options.pairs, _BATCHES * options.batch, options.batch, arch=network.spec.arch)
    for batch in drawn:
        loss(batch)["total"].backward()
    found = gradients_of(network)
    network.zero_grad()
    return found
