"""The measured cells as a table of text, as CSV and as a plot."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from psiamfcpp.files import whole

FIELDS = ("row", "share", "criterion", "tuned", "precision", "auc", "parameters", "gmacs")


def ratio_table(results: list[dict[str, Any]], tuned: bool, figure: str = "precision") -> str:
    """Return the paper's table: one line per row, one column per share KEPT, the best of each line with a star."""
    found = {(r["row"], r["share"]): r[figure] for r in results if r["share"] and r["tuned"] is tuned}
    rows, shares = list(dict.fromkeys(row for row, _ in found)), sorted({share for _, share in found})
    lines = [f"{'kept':16}" + "".join(f"{share:8g}" for share in shares)]
    for row in rows:
        best = max(found[row, share] for share in shares if (row, share) in found)
        marks = {share: "*" if found.get((row, share)) == best else " " for share in shares}
        shown = [f"{found[row, s]:7.3f}{marks[s]}" if (row, s) in found else "       -" for s in shares]
        lines.append(f"{row:16}" + "".join(shown))
    return "\n".join(lines)


def criteria_table(results: list[dict[str, Any]]) -> str:
    """Return one line per criterion on the paper's widths: precision and AUC without and with fine-tuning."""
    found = {(r["criterion"], r["tuned"]): r for r in results if r["row"] == "paper"}
    lines = [f"{'criterion':16} precision    AUC   tuned: precision    AUC"]
    for criterion in dict.fromkeys(name for name, _ in found):
        shown = []
        for tuned in (False, True):
            r = found.get((criterion, tuned))
            shown.append(f"{r['precision']:9.3f} {r['auc']:6.3f}" if r else f"{'-':>9} {'-':>6}")
        lines.append(f"{criterion:16} {shown[0]}          {shown[1]}")
    return "\n".join(lines)


def write_csv(results: list[dict[str, Any]], path: Path) -> None:
    """One line a cell.

    Raises:
        UserError: the file cannot be written.
    """
    with whole(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        writer.writeheader()
        writer.writerows({field: r[field] for field in FIELDS} for r in results)


def draw_sensitivity(results: list[dict[str, Any]], image: Path) -> None:
    """Draw precision against the share kept, one line per row; without fine-tuning on the left, with it on the right.

    Raises:
        UserError: the image cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    stages = sorted({r["tuned"] for r in results if r["share"]})
    figure, panels = plt.subplots(1, len(stages), figsize=(5.5 * len(stages), 4), squeeze=False, layout="constrained")
    unpruned = next((r["precision"] for r in results if r["row"] == "unpruned"), None)
    for axes, tuned in zip(panels.flat, stages, strict=True):
        shown = [r for r in results if r["share"] and r["tuned"] is tuned]
        for row in dict.fromkeys(r["row"] for r in shown):
            line = sorted((r["share"], r["precision"]) for r in shown if r["row"] == row)
            axes.plot(*zip(*line, strict=True), marker=".", label=row)
        if unpruned is not None:
            axes.axhline(unpruned, color="black", linestyle=":", label="unpruned")
        axes.set(xlabel="share of filters kept", ylabel="precision", ylim=(0, 1))
        axes.set_title("fine-tuned" if tuned else "not fine-tuned", fontsize=10)
        axes.grid(alpha=0.3)
    panels.flat[0].legend(fontsize=7)
    with whole(image) as temporary:
        figure.savefig(temporary, format="png", dpi=100)
    plt.close(figure)
