"""The ranks as a plot: one panel per group."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from psiamfcpp.files import whole
from psiamfcpp.pruning.table import RankTable


def draw_ranks(table: RankTable, image: Path) -> None:
    """Draw each group's ranks, highest first, as shares of the highest that the maps' sizes allow.

    Args:
        table: the ranks.
        image: PNG to write.

    Raises:
        UserError: the image cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    columns = min(4, len(table.groups))
    rows = math.ceil(len(table.groups) / columns)
    figure, panels = plt.subplots(
        rows, columns, figsize=(3.4 * columns, 2.4 * rows), squeeze=False, layout="constrained"
    )
    for axes in panels.flat[len(table.groups) :]:
        axes.set_axis_off()
    for axes, (name, group) in zip(panels.flat, table.groups.items(), strict=False):
        for view, shown in group.views.items():
            axes.plot(np.sort(shown.rank)[::-1] / shown.max, label=view, linewidth=1)
        if len(group.views) != 1:
            top = group.max or float(group.rank.max()) or 1.0
            axes.plot(np.sort(group.rank)[::-1] / top, label="combined", linewidth=1.5, color="black")
        notes = [f"{group.dead} dead"] * bool(group.dead) + ["flat"] * group.flat
        axes.set_title(name + (f" ({', '.join(notes)})" if notes else ""), fontsize=9)
        axes.set_ylim(-0.03, 1.05)
        axes.grid(alpha=0.3)
    panels.flat[0].legend(fontsize=7)
    figure.supxlabel("filters, highest rank first", fontsize=9)
    figure.supylabel(f"share of the highest possible rank, {table.images} images", fontsize=9)
    with whole(image) as temporary:
        figure.savefig(temporary, format="png", dpi=100)
    plt.close(figure)
