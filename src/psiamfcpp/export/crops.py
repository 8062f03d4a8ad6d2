"""Crops as the tracker makes them, from labelled clips and photographs: what ranges and checks rest on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.datasets import Sequence
from psiamfcpp.demo.clip import render
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image, to_centre
from psiamfcpp.models.arch import opened
from psiamfcpp.spec import ModelSpec
from psiamfcpp.trackers.siamfcpp.procedure import Procedure, Target

# How far, in target sides, and by what factor the place that the tracker looks about is off.
_SHIFT, _SCALE = 0.4, 1.2
# Frames between template and search crop, at most.
_GAP = 30
_SMALLEST_SIDE = 5.0


@dataclass(frozen=True)
class Pair:
    """What a tracker sees of one target."""

    template: Image
    """``(Z, Z, 3)`` uint8, BGR"""
    search: Image
    """``(S, S, 3)`` uint8, BGR"""


def sample(sequences: list[Sequence], spec: ModelSpec, count: int, seed: int = 0) -> list[Pair]:
    """Crops of ``count`` targets, as many clips or photographs of every source.

    Raises:
        UserError: no sequence has a usable box, or an image cannot be read.
    """
    rng = np.random.default_rng(seed)
    by_source: dict[str, list[Sequence]] = {}
    for sequence in sequences:
        if len(sequence.usable(_SMALLEST_SIDE)):
            by_source.setdefault(sequence.source, []).append(sequence)
    if not by_source:
        raise UserError("the data hold no usable box: check the folders given")
    sources = [by_source[name] for name in sorted(by_source)]
    order = rng.permutation(len(sources))
    pairs = []
    for i in range(count):
        source = sources[order[i % len(order)]]
        pairs.append(_pair(source[int(rng.integers(len(source)))], spec, rng))
    return pairs


def rendered(spec: ModelSpec, count: int) -> list[Pair]:
    """Crops of ``count`` vehicles in as many rendered clips: for those who have no data at hand."""
    rng = np.random.default_rng(0)
    pairs = []
    for seed in range(count):
        shots = [shot for shot in render(seed, 6, (640, 360)) if shot.visible]
        first, later = shots[0], shots[int(rng.integers(len(shots)))]
        pairs.append(_crops(first.image, first.box, later.image, later.box, spec, rng))
    return pairs


def _pair(sequence: Sequence, spec: ModelSpec, rng: np.random.Generator) -> Pair:
    rows = sequence.usable(_SMALLEST_SIDE)
    first = int(rng.choice(rows))
    later = int(rng.choice(rows[np.abs(rows - first) <= _GAP]))
    images = (sequence.frame(row) for row in (first, later))
    return _crops(next(images), sequence.boxes[first], next(images), sequence.boxes[later], spec, rng)


def _crops(
    first: Image, box: ArrayLike, later: Image, later_box: ArrayLike, spec: ModelSpec, rng: np.random.Generator
) -> Pair:
    procedure: Procedure = opened(spec.arch.procedure)
    fill, size = procedure.fill(first), spec.template_size
    template = procedure.crop(first, Target(*to_centre(box)), size, size, fill, None)
    cx, cy, w, h = to_centre(later_box)
    dx, dy = rng.uniform(-_SHIFT, _SHIFT, 2)
    grow_w, grow_h = _SCALE ** rng.uniform(-1, 1, 2)
    around = Target(cx + dx * w, cy + dy * h, w * grow_w, h * grow_h)
    return Pair(template, procedure.crop(later, around, spec.search_size, size, fill, None))
