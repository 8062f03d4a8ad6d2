"""Rank a model's filters over crops, going on where an earlier ranking stopped."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from psiamfcpp.datasets.choice import HELD_OUT_EVERY, DataChoice
from psiamfcpp.errors import UserError
from psiamfcpp.models import Network, load
from psiamfcpp.pruning.groups import Group
from psiamfcpp.pruning.models import groups_of
from psiamfcpp.pruning.plot import draw_ranks
from psiamfcpp.pruning.ranking import Looked, look, table
from psiamfcpp.pruning.record import load_looks, rank_correlation, save_looks, stability
from psiamfcpp.pruning.table import GroupRanks, RankTable
from psiamfcpp.recipes.fit_crops import batches, plain_pairs
from psiamfcpp.training.pairs import PairSampler
from psiamfcpp.watch import QUIET, Watch
from psiamfcpp.zoo import weights_path

_SAVE_SECONDS = 15.0


def rank(
    model: str | Path,
    data: Sequence[str],
    output: str | Path | None = None,
    *,
    images: int = 200,
    batch: int = 4,
    seed: int = 0,
    held_out_every: int = HELD_OUT_EVERY,
    skip_bad: bool = False,
    watch: Watch = QUIET,
) -> RankTable:
    """Rank the filters of a model: the average rank of each filter's map over template and search crops.

    Args:
        model: name of a shipped model, or a model file.
        data: sets to draw crops from, each LAYOUT:FOLDER.
        output: rank table to write, .json. Beside it come a plot (.png) and the ranks image by image (.npz), from which
            the same call goes on after an interruption, or with more images.
        images: pairs of crops, drawn as for training, but without changes of colour and cover.
        batch: pairs per forward pass.
        seed: of the draw.
        held_out_every: the N of training: one clip in N is not drawn from; 0 draws from all.
        skip_bad: leave out of the data what cannot be read; `watch` receives what.
        watch: receives progress.

    Returns:
        The table; its ``about`` says how it was made and how stable the order is.

    Raises:
        UserError: an option out of range, a model or data set that cannot be read, or ranks beside the output that
            are of something else.
    """
    if images < 2 or batch < 1:
        raise UserError(
            f"images ({images}) must be at least 2, since halves are compared, and batch ({batch}) at least 1"
        )
    output = None if output is None else Path(output)
    if output and (output.suffix in (".png", ".npz") or not output.parent.is_dir()):
        raise UserError(f"output {output} must be a .json file in a folder that exists")
    network, choice = load(model), DataChoice(tuple(data), held_out_every, skip_bad)
    sequences = choice.training
    choice.note_left_out(watch.note)
    pairs = plain_pairs(sequences, network.spec, seed)
    groups = groups_of(network.spec)
    about = {
        "model": Path(model).stem,
        "architecture": network.spec.architecture,
        "data": choice.named,
        "held_out_every": held_out_every,
        "seed": seed,
        "search_size": network.spec.search_size,
    }
    digest = hashlib.sha256(weights_path(model).read_bytes()).hexdigest()
    key = json.dumps({**about, "weights": digest, "targets": len(sequences)}, sort_keys=True)
    state = output.with_suffix(".npz") if output else None
    looks = _look(network, groups, pairs, images, batch, state, key, watch)
    ranks = table(network, groups, looks)
    left_out = {"left_out": choice.left_out} if skip_bad else {}
    ranks = dataclasses.replace(ranks, about={**about, **left_out, **ranks.about, "stability": stability(looks)})
    if output:
        ranks.write(output)
        draw_ranks(ranks, output.with_suffix(".png"))
    return ranks


def summary(ranks: RankTable) -> dict[str, dict[str, Any]]:
    """Return a row for each group of a table that `rank` made.

    Returns:
        By group: ``filters``, ``dead``, ``flat``, ``lowest``, ``median``, ``highest``, ``max`` (highest possible),
        ``views``, ``half_correlation`` (of the orders by even and odd images), ``view_correlation``.
    """
    rows = {}
    for name, group in ranks.groups.items():
        rows[name] = {
            "filters": len(group.rank),
            "dead": group.dead,
            "flat": group.flat,
            "lowest": float(group.rank.min()),
            "median": float(sorted(group.rank)[len(group.rank) // 2]),
            "highest": float(group.rank.max()),
            "max": group.max,
            "views": {key: {"mean": float(v.rank.mean()), "max": v.max} for key, v in group.views.items()},
            "half_correlation": ranks.about["stability"][name][-1]["correlation"],
            "view_correlation": _views_agree(group),
        }
    return rows


def _look(
    network: Network,
    groups: Mapping[str, Group],
    pairs: PairSampler,
    images: int,
    batch: int,
    state: Path | None,
    key: str,
    watch: Watch,
) -> list[dict[str, Looked]]:
    """Ranks of ``images`` pairs, image by image; what the state file holds is not done again."""
    looks = load_looks(state, key) if state else []
    done = sum(len(next(iter(seen.values())).ranks[0]) for seen in looks)
    if done:
        watch.note(f"{done} pairs of crops are ranked already ({state})")
    saved, left = time.monotonic(), -(-max(images - done, 0) // batch)
    try:
        crops = batches(pairs, done, images, batch)
        for seen in watch.track(look(network, crops, groups), "batches of crops", left):
            looks.append(seen)
            if state and time.monotonic() - saved > _SAVE_SECONDS:
                save_looks(state, key, looks)
                saved = time.monotonic()
    finally:
        if state and looks:
            save_looks(state, key, looks)
    return looks


def _views_agree(group: GroupRanks) -> float | None:
    """Rank correlation of the orders that template and search crops give; None where there is but one of them."""
    return rank_correlation(*(view.rank for view in group.views.values())) if len(group.views) == 2 else None
