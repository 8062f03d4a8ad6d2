"""`psiamfcpp rank`."""

from __future__ import annotations

import dataclasses
import hashlib
import json as json_module
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from psiamfcpp import datasets
from psiamfcpp.cli.output import notes, print_json, progress
from psiamfcpp.errors import UserError
from psiamfcpp.zoo import weights_path

if TYPE_CHECKING:
    from psiamfcpp.models import SiamFCpp
    from psiamfcpp.pruning.groups import Group
    from psiamfcpp.pruning.ranking import Looked
    from psiamfcpp.pruning.table import GroupRanks, RankTable
    from psiamfcpp.training.pairs import PairSampler

_SAVE_SECONDS = 15.0


def rank(
    model: Annotated[str, tyro.conf.Positional],
    data: tuple[str, ...],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    images: int = 200,
    batch: int = 4,
    seed: int = 0,
    json: bool = False,
) -> None:
    """Average rank of each filter's map over template and search crops, as a table to plan pruning with.

    Beside the table it writes a picture (.png) and the ranks image by image (.npz), from which the same command goes
    on after an interruption, or with more images.

    Args:
        model: name of a shipped model, or a model file.
        data: sets to draw crops from, each LAYOUT:FOLDER (an unknown layout lists the known ones).
        output: rank table to write, .json.
        images: pairs of crops, drawn as for training, but without changes of colour and cover.
        batch: pairs a forward pass.
        seed: of the draw.
        json: print one JSON object.
    """
    if images < 2 or batch < 1:
        raise UserError(
            f"images ({images}) must be at least 2, since halves are compared, and batch ({batch}) at least 1"
        )
    if output.suffix in (".png", ".npz") or not output.parent.is_dir():
        raise UserError(f"output {output} must be a .json file in a folder that exists")
    from psiamfcpp.models import load
    from psiamfcpp.pruning.crops import plain_pairs
    from psiamfcpp.pruning.groups import siamfcpp_groups
    from psiamfcpp.pruning.plot import draw_ranks
    from psiamfcpp.pruning.ranking import table
    from psiamfcpp.pruning.record import stability

    network = load(model)
    size = network.spec.search_size
    sequences = [s for entry in data for s in datasets.read_entry(entry)]
    pairs = plain_pairs(sequences, size, seed)
    groups = siamfcpp_groups(network.spec.widths)
    about = {
        "model": Path(model).stem,
        "data": [datasets.named(entry) for entry in data],
        "seed": seed,
        "search_size": size,
    }
    state = output.with_suffix(".npz")
    key = json_module.dumps({**about, "weights": _digest(model), "targets": len(sequences)}, sort_keys=True)
    looks = _look(network, groups, pairs, images, batch, state, key)
    ranks = table(network, groups, looks)
    ranks = dataclasses.replace(ranks, about={**about, **ranks.about, "stability": stability(looks)})
    ranks.write(output)
    draw_ranks(ranks, output.with_suffix(".png"))
    summary = _summary(ranks)
    if json:
        print_json({"images": ranks.images, **ranks.about, "groups": summary})
    else:
        _print(ranks, summary)


def _look(
    network: SiamFCpp,
    groups: Mapping[str, Group],
    pairs: PairSampler,
    images: int,
    batch: int,
    state: Path,
    key: str,
) -> list[dict[str, Looked]]:
    """Ranks of so many pairs, image by image, taken up from the state file and kept in it."""
    from psiamfcpp.pruning.crops import batches
    from psiamfcpp.pruning.ranking import look
    from psiamfcpp.pruning.record import load_looks, save_looks

    looks = load_looks(state, key)
    done = _count(looks)
    if done:
        notes.print(f"{done} pairs of crops are ranked already ({state})")
    saved = time.monotonic()
    with progress() as bar:
        task = bar.add_task("pairs of crops", total=max(images, done), completed=done)
        try:
            for seen in look(network, batches(pairs, done, images, batch), groups):
                looks.append(seen)
                bar.update(task, completed=_count(looks))
                if time.monotonic() - saved > _SAVE_SECONDS:
                    save_looks(state, key, looks)
                    saved = time.monotonic()
        finally:
            if looks:
                save_looks(state, key, looks)
    return looks


def _count(looks: list[dict[str, Looked]]) -> int:
    return sum(len(next(iter(seen.values())).ranks[0]) for seen in looks)


def _digest(model: str) -> str:
    return hashlib.sha256(weights_path(model).read_bytes()).hexdigest()


def _summary(ranks: RankTable) -> dict[str, Any]:
    rows = {}
    for name, group in ranks.groups.items():
        last = ranks.about["stability"][name][-1]
        rows[name] = {
            "filters": len(group.rank),
            "dead": group.dead,
            "flat": group.flat,
            "lowest": float(group.rank.min()),
            "median": float(sorted(group.rank)[len(group.rank) // 2]),
            "highest": float(group.rank.max()),
            "max": group.max,
            "views": {key: {"mean": float(v.rank.mean()), "max": v.max} for key, v in group.views.items()},
            "half_correlation": last["correlation"],
            "view_correlation": _views_agree(group),
        }
    return rows


def _views_agree(group: GroupRanks) -> float | None:
    """Rank correlation of the orders that template and search crops give; None where there is but one of them."""
    from psiamfcpp.pruning.record import rank_correlation

    return rank_correlation(*(view.rank for view in group.views.values())) if len(group.views) == 2 else None


def _print(ranks: RankTable, summary: dict[str, Any]) -> None:
    print(f"{ranks.images} pairs of crops; tolerance: {ranks.about['tolerance']}")
    print(f"{'group':15} filters  dead   lowest   median  highest  possible  halves agree  views agree")
    for name, row in summary.items():
        halves, views = (_shown(row[key]) for key in ("half_correlation", "view_correlation"))
        numbers = f"{row['lowest']:8.2f} {row['median']:8.2f} {row['highest']:8.2f}  {row['max']:8.1f}"
        flat = "  flat" if row["flat"] else ""
        print(f"{name:15} {row['filters']:7} {row['dead']:5} {numbers}  {halves:>12}  {views:>11}{flat}")
    alike = [name for name, row in summary.items() if row["flat"]]
    if alike:
        print(f"flat: in {', '.join(alike)} all ranks are alike, and their order says nothing")


def _shown(correlation: float | None) -> str:
    return "-" if correlation is None else f"{correlation:.3f}"
