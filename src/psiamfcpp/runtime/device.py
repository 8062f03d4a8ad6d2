"""Where an engine computes: on the processor, or on a GPU."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, cast

from psiamfcpp.errors import UserError

DeviceKind = Literal["cpu", "cuda", "tensorrt"]


@dataclass(frozen=True, slots=True)
class Device:
    """The processor, or one GPU and the library that computes on it."""

    kind: DeviceKind = "cpu"
    index: int = 0
    """number of the GPU, from 0"""

    def __str__(self) -> str:
        return self.kind if self.kind == "cpu" else f"{self.kind}:{self.index}"


CPU = Device()


def parse_device(text: str) -> Device:
    """Read ``cpu``, ``cuda``, ``cuda:1``, ``tensorrt`` or ``tensorrt:1``.

    Raises:
        UserError: it is none of these.
    """
    found = re.fullmatch(r"cpu|(cuda|tensorrt)(?::(\d{1,3}))?", text, re.ASCII)
    if found is None:
        raise UserError(
            f"unknown device {text!r}: known are cpu, cuda and tensorrt, with the GPU's number as in cuda:1"
        )
    kind, index = found.groups()
    return CPU if kind is None else Device(cast(DeviceKind, kind), int(index or 0))
