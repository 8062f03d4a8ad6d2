"""`psiamfcpp rank`."""

from __future__ import annotations

from psiamfcpp.cli.arguments import HeldOut, Json, Model, Output, SkipBad
from psiamfcpp.cli.output import print_json, watching
from psiamfcpp.datasets.choice import HELD_OUT_EVERY


def rank(
    model: Model,
    data: tuple[str, ...],
    output: Output,
    images: int = 200,
    batch: int = 4,
    seed: int = 0,
    held_out_every: HeldOut = HELD_OUT_EVERY,
    skip_bad: SkipBad = False,
    json: Json = False,
) -> None:
    """Average the rank of each filter's map over template and search crops, as a table to plan pruning with.

    Beside the table it writes a plot (.png) and the ranks image by image (.npz), from which the same command goes on
    after an interruption, or with more images.

    Args:
        data: sets to draw crops from, each LAYOUT:FOLDER (an unknown layout lists the known ones).
        output: rank table to write, .json.
        images: pairs of crops, drawn as for training, but without changes of colour and cover.
        batch: pairs per forward pass.
        seed: of the draw.
    """
    from psiamfcpp.recipes import rank as recipe

    with watching() as watch:
        ranks = recipe.rank(
            model,
            data,
            output,
            images=images,
            batch=batch,
            seed=seed,
            held_out_every=held_out_every,
            skip_bad=skip_bad,
            watch=watch,
        )
    rows = recipe.summary(ranks)
    if json:
        print_json({"images": ranks.images, **ranks.about, "groups": rows})
        return
    print(f"{ranks.images} pairs of crops; tolerance: {ranks.about['tolerance']}")
    print(f"{'group':15} filters  dead   lowest   median  highest  possible  halves agree  views agree")
    for name, row in rows.items():
        halves, views = (_shown(row[key]) for key in ("half_correlation", "view_correlation"))
        numbers = f"{row['lowest']:8.2f} {row['median']:8.2f} {row['highest']:8.2f}  {row['max']:8.1f}"
        flat = "  flat" if row["flat"] else ""
        print(f"{name:15} {row['filters']:7} {row['dead']:5} {numbers}  {halves:>12}  {views:>11}{flat}")
    alike = [name for name, row in rows.items() if row["flat"]]
    if alike:
        print(f"flat: in {', '.join(alike)} all ranks are alike, and their order says nothing")


def _shown(correlation: float | None) -> str:
    return "-" if correlation is None else f"{correlation:.3f}"
