"""Precision against speed, as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from psiamfcpp.errors import UserError


def draw(rows: list[dict[str, Any]], precisions: dict[str, float], path: Path) -> None:
    """Draw each row of the benchmark whose precision is known.

    Args:
        rows: what `psiamfcpp bench --json` prints.
        precisions: by model.
        path: image to write.

    Raises:
        UserError: no row has a precision, or the image cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    known = [row for row in rows if row["model"] in precisions]
    if not known:
        raise UserError(f"no precision is known of {', '.join(row['model'] for row in rows)}: evaluate these by name")
    figure, axes = pyplot.subplots(figsize=(7, 4.5), layout="constrained")
    for row in known:
        x, y = 1000 / row["ms_median"], precisions[row["model"]]
        axes.plot(x, y, "o")
        axes.annotate(f"{row['model']}, {row['engine']}", (x, y), xytext=(5, 5), textcoords="offset points", fontsize=8)
    axes.set(xlabel="updates a second", ylabel="precision at 20 pixels", xscale="log")
    axes.grid(alpha=0.3)
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise UserError(f"picture {path} cannot be written: {error}") from None
    finally:
        pyplot.close(figure)
