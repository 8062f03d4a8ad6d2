"""The training curve as an image."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.errors import UserError
from psiamfcpp.files import parse_json, read_text, whole


def draw_curve(log: Path, image: Path) -> None:
    """Draw the losses and the held-out pair score of a log.

    Args:
        log: the run's ``log.jsonl``.
        image: PNG to write.

    Raises:
        UserError: the log is missing or damaged, or the image cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    try:
        rows = [parse_json(line, f"training log {log}") for line in read_text(log, "training log").splitlines()]
        steps = [r["step"] for r in rows]
        known = ("cls", "centerness", "iou", "teacher")
        parts = {name: [r[name] for r in rows] for name in known if any(name in r for r in rows)}
        parts = parts or {"total": [r["total"] for r in rows]}
        checks = [(r["step"], r["validation"]) for r in rows if "validation" in r]
        shares = {
            name: [v[name] for _, v in checks] for name in ("within8", "within16", "overlap", "score", "separation")
        }
    except (KeyError, TypeError) as error:
        raise UserError(f"training log {log} is damaged: a row holds no {error}") from None
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for name, values in parts.items():
        left.plot(steps, values, label=name)
    left.set(xlabel="step", ylabel="loss", ylim=(0, None))
    left.legend()
    for name, values in shares.items():
        right.plot([step for step, _ in checks], values, label=name)
    right.set(xlabel="step", ylabel="held-out pairs", ylim=(0, 1))
    right.legend(loc="lower right")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    with whole(image) as temporary:
        figure.savefig(temporary, format="png", dpi=100)
    plt.close(figure)
