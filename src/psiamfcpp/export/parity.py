"""What exported graphs say against what the network says, on the same crops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.export.crops import Pair
from psiamfcpp.geometry import from_corners, overlap
from psiamfcpp.runtime import Engine
from psiamfcpp.runtime.engine import Float32Array

Answer = tuple[Float32Array, Float32Array]

# Float graphs differ from torch by rounding alone; boxes are in pixels of the crop.
_SCORES, _BOXES = 1e-3, 0.05
# Eight bits move scores and boxes a little; an export that went wrong moves them far.
_OVERLAP = 0.9


@dataclass(frozen=True)
class Difference:
    """How far two engines are apart."""

    scores: float
    """largest difference of a score, over all cells"""
    boxes: float
    """largest difference of a corner in pixels of the crop, over the cells that count: half the peak's score or more"""
    overlap: float
    """mean overlap of the boxes that they choose"""

    def __str__(self) -> str:
        """Return the three figures in words."""
        return (
            f"scores differ by up to {self.scores:.1e}, boxes by up to {self.boxes:.1e} pixels, "
            f"chosen boxes overlap by {self.overlap:.4f}"
        )

    def check(self, int8: bool) -> None:
        """Raise unless the graphs may stand for the network.

        Raises:
            UserError: they differ by more than rounding, or with ``int8`` by more than 8 bits explain.
        """
        if int8:
            if not self.overlap >= _OVERLAP:
                raise UserError(f"8 bits change the boxes: they overlap by {self.overlap:.3f}; nothing was written")
        elif not (self.scores <= _SCORES and self.boxes <= _BOXES):
            apart = f"scores differ by up to {self.scores:.2g} and boxes by up to {self.boxes:.2g} pixels"
            hint = "graphs keep weights in 16 bits, which a network that was not trained may not bear"
            raise UserError(f"the graphs are not the network: {apart} ({hint}); nothing was written")


def look(engine: Engine, pairs: list[Pair]) -> list[Answer]:
    """Scores ``(N, N)`` and boxes ``(N, N, 4)`` for every pair."""
    return [engine.search(pair.search, engine.template(pair.template)) for pair in pairs]


def compare(expected: list[Answer], found: list[Answer]) -> Difference:
    """Return how far the answers are from those that were expected, pair by pair.

    Raises:
        UserError: the expected scores of a pair are all alike, so that nothing could be seen to differ.
    """
    scores, boxes, overlaps = [], [], []
    for (s0, b0), (s, b) in zip(expected, found, strict=True):
        if s0.max() == s0.min():
            raise UserError("the network's scores are alike everywhere in a crop: train it before it is exported")
        scores.append(np.abs(s - s0).max())
        counts = s0 >= s0.max() / 2
        boxes.append(np.abs(b - b0)[counts].max())
        chosen = (from_corners(b_.reshape(-1, 4)[s_.argmax()]) for s_, b_ in ((s0, b0), (s, b)))
        overlaps.append(overlap(*chosen))
    return Difference(float(np.max(scores)), float(np.max(boxes)), float(np.mean(overlaps)))
