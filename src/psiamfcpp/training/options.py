"""What decides a training run, and how it is carried out; torch is not imported here, so that --help is quick."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from psiamfcpp.errors import UserError
from psiamfcpp.models.arch import ARCHITECTURES, DEFAULT, architecture


def _check_size(size: int) -> None:
    """Refuse a search size that no architecture takes; that of the network is compared when it is known."""
    for name in ARCHITECTURES:
        try:
            architecture(name).score_size(size)
        except UserError:
            continue
        return
    architecture(DEFAULT).score_size(size)


@dataclass(frozen=True)
class PairOptions:
    """How pairs are drawn; shift, scale, negatives and gap are SiamFC++'s."""

    search_size: int = 303
    """side of the search crop, pixels"""
    shift: float = 0.4
    """largest shift of the target from the search crop's centre, as a share of half its side"""
    scale: float = 0.3
    """largest change of scale of the search crop: the factor lies in [1/(1+scale), 1+scale]"""
    negatives: float = 0.1
    """share of pairs whose search crop shows another object, of the same image where there is one"""
    max_gap: int = 100
    """largest number of frames between the two crops of a clip"""
    clip_share: float = 0.5
    """share of pairs from clips where there are both clips and photographs"""
    augmentation: float = 1.0
    """strength of colour, blur, grey, rotation, occlusion and what is pasted in; 0 is none"""

    def __post_init__(self) -> None:
        _check_size(self.search_size)
        for name in ("negatives", "clip_share", "augmentation", "shift"):
            if not 0 <= getattr(self, name) <= 1:
                raise UserError(f"{name.replace('_', '-')} is {getattr(self, name):g}: it must lie in 0..1")
        if self.scale < 0 or self.max_gap < 0:
            raise UserError("scale and max-gap must not be below 0")


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
    unfreeze: dict[str, float] = field(default_factory=lambda: dict(architecture(DEFAULT).unfreeze))
    """share of the run after which a backbone layer is trained; 1 is never (the authors': 5, 10, 15 of 20 epochs)"""
    low_every: int = 1
    """conv1 and conv2, where free, are trained on one step in N; their gradients cost a third of a step"""

    def __post_init__(self) -> None:
        layers = sorted({layer for name in ARCHITECTURES for layer in architecture(name).unfreeze})
        for layer, share in self.unfreeze.items():
            if layer not in layers or not 0 <= share <= 1:
                raise UserError(f"unfreeze {layer}={share:g}: layers are {', '.join(layers)}, shares lie in 0..1")
        if self.low_every < 1:
            raise UserError(f"low-every is {self.low_every}: it must be at least 1")
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
        free = frozenset(layer for layer, share in self.unfreeze.items() if step >= share * self.steps)
        return free if step % self.low_every == 0 else free - {"conv1", "conv2"}


@dataclass(frozen=True)
class LossWeights:
    """Weights of the three losses; the defaults are SiamFC++'s."""

    cls_weight: float = 1.0
    """weight of the focal loss of the class"""
    centerness_weight: float = 1.0
    """weight of the centre-ness loss"""
    iou_weight: float = 3.0
    """weight of the overlap loss"""
    focal_alpha: float = 0.25
    """weight of positive cells in the focal loss, against 1 - alpha of negative ones; more gives higher scores"""


@dataclass(frozen=True)
class TeacherOptions:
    """A network to learn from, beside the labels."""

    teacher: str = ""
    """model whose scores and boxes to learn as well: a shipped model's name, or a file; for a pruned network normally
    the one that it was cut from"""
    teacher_weight: float = 1.0
    """weight of the teacher's scores and boxes against the labels' losses"""
    teacher_features: float = 0.0
    """weight of the teacher's backbone features, likewise; the network's must be as many"""
    stored: str = ""
    """folder of what LightFC said of this run's pairs, stored beforehand; or a LightFC to ask in every step, for a GPU
    (see docs/training.md)"""
    stored_weight: float = 1.0
    """weight of the stored places and boxes against the labels' losses"""

    def __post_init__(self) -> None:
        for name in ("teacher_weight", "teacher_features", "stored_weight"):
            if not 0 <= getattr(self, name) < math.inf:
                raise UserError(f"{name.replace('_', '-')} is {getattr(self, name):g}: it must be a number from 0 up")
        if self.teacher_features and not self.teacher:
            raise UserError("teacher-features needs --teacher")


@dataclass(frozen=True)
class TrainOptions:
    """Everything that decides the result of a run, apart from data and initial weights."""

    pairs: PairOptions = PairOptions()
    schedule: Schedule = field(default_factory=Schedule)
    losses: LossWeights = LossWeights()
    teacher: TeacherOptions = TeacherOptions()
    batch: int = 32
    """pairs per step and process"""
    optimizer: Literal["adamw", "sgd"] = "adamw"
    """adamw, or sgd with the authors' momentum"""
    weight_decay: float = 1e-4
    """weight decay of convolution weights"""
    clip: float = 10.0
    """largest norm of the gradient"""
    ema: float = 0.999
    """decay of the running mean of the weights, which is what is validated and saved; 0 keeps the last weights"""
    seed: int = 0
    """seed of pairs and augmentation"""

    def __post_init__(self) -> None:
        if self.batch < 1 or not 0 <= self.ema < 1 or self.clip <= 0:
            raise UserError("batch must be at least 1, ema in 0..1 without 1, and clip above 0")


# A fine-tune of minutes, for comparisons of many networks.
SHORT = TrainOptions(schedule=Schedule(steps=200, lr=3e-4), batch=16, ema=0.99)


@dataclass(frozen=True)
class RunOptions:
    """How a run is carried out; none of it decides the result."""

    bf16: bool = True
    """compute in bfloat16 where the processor has it; `--no-bf16` computes in float32"""
    workers: int = 1
    """loader processes"""
    cache_gb: float = 6.0
    """decoded images kept in memory by each loader process, GB"""
    validate_every: int = 500
    """steps between validations"""
    save_every: int = 250
    """steps between saved states"""
    validation_pairs: int = 512
    """held-out pairs per validation"""
    frames: str = ""
    """folder that keeps the decoded frames of videos; by default, frames in the run's folder"""
    compile: bool = False
    """compile the network (torch.compile): worth its minutes on a GPU"""
    max_time: float = math.inf
    """minutes after which to save and end, wherever the run is; the same command continues it"""
    first_step: int = 0
    """step to begin at where the folder holds no state: to go on from a checkpoint of a run with these options"""

    def __post_init__(self) -> None:
        if (
            min(self.validate_every, self.save_every, self.validation_pairs) < 1
            or self.workers < 0
            or self.cache_gb < 0
            or self.first_step < 0
        ):
            raise UserError(
                "validate-every, save-every and validation-pairs must be at least 1, workers, cache-gb and first-step 0"
            )
        if not self.max_time > 0:
            raise UserError(f"max-time is {self.max_time:g}: it must be above 0 minutes")
