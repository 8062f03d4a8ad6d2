"""Ranks image by image: what a ranking that was stopped goes on from, and how stable an order is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.errors import UserError, brief
from psiamfcpp.files import check_file, whole
from psiamfcpp.geometry import FloatArray
from psiamfcpp.pruning.ranking import Looked

_MOST_BYTES = 2**31
# Numbers of images after which the stability of the order is stated; halves of each are compared.
_STEPS = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000)


def save_looks(path: Path, key: str, looks: list[dict[str, Looked]]) -> None:
    """Write what was seen, under a temporary name first.

    Args:
        path: where to, normally ``*.npz``.
        key: what the ranks depend on; `load_looks` wants the same.
        looks: batches, at least one.

    Raises:
        UserError: the file cannot be written.
    """
    arrays: dict[str, NDArray[np.generic]] = {"key": np.array(key)}
    for name, first in looks[0].items():
        arrays[f"{name}/sizes"] = np.array(first.sizes)
        for k in range(len(first.ranks)):
            arrays[f"{name}/{k}"] = np.concatenate([seen[name].ranks[k] for seen in looks])
    with whole(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def load_looks(path: Path, key: str) -> list[dict[str, Looked]]:
    """What `save_looks` wrote, as one batch; nothing where there is no such file.

    Raises:
        UserError: the file is damaged, or its ranks depend on something else.
    """
    if not path.exists():
        return []
    check_file(path, "ranks", "remove it to begin anew")
    try:
        with np.load(path, allow_pickle=False) as file:
            if sum(entry.file_size for entry in file.zip.infolist()) > _MOST_BYTES:
                raise ValueError(f"it grows beyond {_MOST_BYTES:,} bytes")
            arrays = dict(file)
        names = [name.removesuffix("/sizes") for name in arrays if name.endswith("/sizes")]
        sizes = {name: tuple(int(v) for v in arrays[f"{name}/sizes"]) for name in names}
        batch = {name: Looked(tuple(arrays[f"{name}/{k}"] for k in range(len(s))), s) for name, s in sizes.items()}
        found = str(arrays["key"])
    except Exception as error:  # a damaged archive can fail in any way
        raise UserError(f"{path} cannot be read ({brief(error)}): remove it to begin anew") from None
    if found != key:
        raise UserError(f"{path} is of another model, other data or another seed: remove it, or choose another output")
    return [batch]


def stability(looks: list[dict[str, Looked]]) -> dict[str, list[dict[str, float | int | None]]]:
    """How alike the orders are that two halves of the images give, for growing numbers of images.

    Returns:
        For each group rows of ``images`` and ``correlation``: Spearman's, between the mean ranks over the images of
        even and of odd number among the first N; None where all ranks of a half are equal.
    """
    rows: dict[str, list[dict[str, float | int | None]]] = {}
    for name, first in looks[0].items():
        per_map = [np.concatenate([seen[name].ranks[k] for seen in looks]) for k in range(len(first.ranks))]
        by_image: FloatArray = np.stack(per_map).astype(np.float64).mean(axis=0)
        counts = sorted({n for n in _STEPS if n < len(by_image)} | {len(by_image)})
        rows[name] = [
            {"images": n, "correlation": rank_correlation(by_image[0:n:2].mean(axis=0), by_image[1:n:2].mean(axis=0))}
            for n in counts
            if n > 1
        ]
    return rows


def rank_correlation(a: FloatArray, b: FloatArray) -> float | None:
    """Spearman's correlation of ``(n,)`` and ``(n,)``, ties sharing their mean place; None where one is constant."""
    first, second = _places(a), _places(b)
    if first.std() == 0 or second.std() == 0:
        return None
    return float(np.corrcoef(first, second)[0, 1])


def _places(values: FloatArray) -> FloatArray:
    """Place of each value in the sorted order; equal values share the mean of theirs."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts) - 1
    return (last - (counts - 1) / 2)[inverse]
