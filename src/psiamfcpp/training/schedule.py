"""Learning rate and freezing, as functions of the step."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from psiamfcpp.errors import UserError


@dataclass(frozen=True)
class Schedule:
    """Learning rate and freezing over a run."""

    steps: int = 20000
    """steps of the whole run"""
    lr: float = 1e-3
    """highest learning rate of neck and head"""
    warmup: float = 0.05
    """share of the run over which the rate rises"""
    final_lr: float = 0.01
    """share of the highest rate that is left at the end of the cosine"""
    backbone_lr: float = 0.1
    """rate of the backbone against that of neck and head"""
    unfreeze: dict[str, float] = field(default_factory=lambda: {"conv5": 0.25, "conv4": 0.5, "conv3": 0.75})
    """share of the run after which a backbone layer is trained (the authors': 5, 10 and 15 of 20 epochs); others never"""

    def __post_init__(self) -> None:
        layers = [f"conv{i}" for i in range(1, 6)]
        for layer, share in self.unfreeze.items():
            if layer not in layers or not 0 <= share <= 1:
                raise UserError(f"unfreeze {layer}={share:g}: layers are {', '.join(layers)}, shares lie in 0..1")
        if self.steps < 1 or self.lr <= 0:
            raise UserError(f"steps ({self.steps}) and learning rate ({self.lr:g}) must be above 0")

    def rate(self, step: int) -> float:
        """Learning rate of neck and head at a step: linear warm-up, then half a cosine."""
        warm = max(1, round(self.warmup * self.steps))
        if step < warm:
            return self.lr * (step + 1) / warm
        done = (step - warm) / max(1, self.steps - warm)
        return self.lr * (self.final_lr + (1 - self.final_lr) * (1 + math.cos(math.pi * done)) / 2)

    def free(self, step: int) -> frozenset[str]:
        """Backbone layers that are trained at a step."""
        return frozenset(layer for layer, share in self.unfreeze.items() if step >= share * self.steps)
