"""Clips kept out of training."""

from __future__ import annotations

import re
import zlib

from psiamfcpp.datasets.sequence import Sequence


def split(sequences: list[Sequence], every: int) -> tuple[list[Sequence], list[Sequence]]:
    """Sequences to train on, and clips held out: those whose video has a name with a multiple of ``every`` for CRC-32.

    By name and not by place, so that adding data moves no clip from one side to the other; by video, since two clips
    cut from one, or two targets in it, look alike.
    """
    held_out = [s for s in sequences if every and len(s) > 1 and zlib.crc32(video(s).encode()) % every == 0]
    held = {id(s) for s in held_out}
    return [s for s in sequences if id(s) not in held], held_out


def video(sequence: Sequence) -> str:
    """The video a sequence was cut from: its clip's name without a number at the end (``road_0``, ``road_120``)."""
    return re.sub(r"_\d+$", "", sequence.clip or sequence.name)
