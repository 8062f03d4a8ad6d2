"""Clips kept out of training."""

from __future__ import annotations

import zlib

from psiamfcpp.datasets.sequence import Sequence


def split(sequences: list[Sequence], every: int) -> tuple[list[Sequence], list[Sequence]]:
    """Sequences to train on, and clips held out: those whose name's CRC-32 is a multiple of ``every``.

    By name and not by place, so that adding data moves no clip from one side to the other.
    """
    held_out = [s for s in sequences if every and len(s) > 1 and zlib.crc32(s.name.encode()) % every == 0]
    held = {id(s) for s in held_out}
    return [s for s in sequences if id(s) not in held], held_out
