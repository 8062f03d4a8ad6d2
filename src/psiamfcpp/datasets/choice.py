"""The data that a command was given, and the part of them that is held out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from psiamfcpp.datasets import named, read_entry
from psiamfcpp.datasets.sequence import Sequence
from psiamfcpp.datasets.split import split
from psiamfcpp.errors import UserError


@dataclass(frozen=True)
class DataChoice:
    """Data sets, of which one clip in N is held out, chosen by a hash of its name; read when first asked for.

    Whoever fits anything to data takes `training`, with the N of the training run: then no held-out clip leaks.
    """

    entries: tuple[str, ...]
    """each ``LAYOUT:FOLDER``"""
    held_out_every: int = 0
    """N; 0 holds out none"""

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
            UserError: a data set cannot be read.
        """
        return self._parts[0]

    @property
    def held_out(self) -> list[Sequence]:
        """The clips that are held out.

        Raises:
            UserError: a data set cannot be read.
        """
        return self._parts[1]

    @property
    def named(self) -> list[str]:
        """The data sets as a model's provenance names them: without where the folders lie."""
        return [named(entry) for entry in self.entries]

    @cached_property
    def _parts(self) -> tuple[list[Sequence], list[Sequence]]:
        return split([s for entry in self.entries for s in read_entry(entry)], self.held_out_every)
