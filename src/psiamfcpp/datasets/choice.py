"""The data that a command was given, and the part of them that is held out."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from psiamfcpp.datasets import named, read_entry
from psiamfcpp.datasets.sequence import Sequence
from psiamfcpp.datasets.split import split
from psiamfcpp.errors import UserError
from psiamfcpp.images import is_readable

_NAMED = 20

HELD_OUT_EVERY = 10
"""N of the commands that hold out one clip in N, unless another is given"""


@dataclass(frozen=True)
class DataChoice:
    """Data sets, of which one clip in N is held out, chosen by a hash of its name; read when first asked for.

    Whoever fits anything to data takes `training`, with the N of the training run: then no held-out clip leaks.
    """

    entries: tuple[str, ...]
    """each ``LAYOUT:FOLDER``"""
    held_out_every: int = 0
    """N; 0 holds out none"""
    skip_bad: bool = False
    """leave out what is not as a layout says, instead of refusing the whole set"""

    def __post_init__(self) -> None:
        """Check N.

        Raises:
            UserError: N is negative.
        """
        if self.held_out_every < 0:
            raise UserError(f"held-out-every is {self.held_out_every}: it must be 0 or more")

    @property
    def training(self) -> list[Sequence]:
        """Photographs, and the clips that are not held out.

        Raises:
            UserError: a data set cannot be read, or all clips are held out and there are no photographs.
        """
        kept, held_out, _ = self._parts
        if held_out and not kept:
            raise UserError(
                f"nothing is left of the data: --held-out-every {self.held_out_every} holds out "
                f"{', '.join(clip.name for clip in held_out[:3])}{' ...' * (len(held_out) > 3)}: give more clips, or 0"
            )
        return kept

    @property
    def held_out(self) -> list[Sequence]:
        """The clips that are held out.

        Raises:
            UserError: a data set cannot be read.
        """
        return self._parts[1]

    @property
    def left_out(self) -> list[str]:
        """A line on each row, image and sequence that was left out, which only ``skip_bad`` allows.

        Raises:
            UserError: a data set cannot be read.
        """
        return self._parts[2]

    def note_left_out(self, note: Callable[[str], Any]) -> None:
        """Say what was left out: how much, and the first of it by name.

        Raises:
            UserError: a data set cannot be read.
        """
        if self.left_out:
            note(f"{len(self.left_out)} rows, images or sequences of the data are left out:")
        for line in self.left_out[:_NAMED]:
            note(f"  {line}")
        if len(self.left_out) > _NAMED:
            note(f"  and {len(self.left_out) - _NAMED} more")

    @property
    def named(self) -> list[str]:
        """The data sets as a model's provenance names them: without where the folders lie."""
        return [named(entry) for entry in self.entries]

    @cached_property
    def _parts(self) -> tuple[list[Sequence], list[Sequence], list[str]]:
        left_out: list[str] = []
        bad = left_out if self.skip_bad else None
        sequences = [s for entry in self.entries for s in read_entry(entry, bad)]
        if self.skip_bad:
            readable = functools.cache(is_readable)
            sequences = [_without_bad_images(s, readable, left_out) for s in sequences]
        return *split(sequences, self.held_out_every), list(dict.fromkeys(left_out))


def _without_bad_images(sequence: Sequence, readable: Callable[[Path], bool], left_out: list[str]) -> Sequence:
    """A sequence that has no box in frames whose image cannot be read."""
    boxes = sequence.boxes.copy()
    for row in sequence.usable():
        frame = sequence.frames[row]
        if isinstance(frame, Path) and not readable(frame):
            left_out.append(f"image {frame} cannot be read")
            boxes[row] = np.nan
    return dataclasses.replace(sequence, boxes=boxes)
