"""Facts about this machine: usable cores, the processor's name, and what it computes in hardware."""

from __future__ import annotations

import os
import platform
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")
"""where Linux describes its processors; macOS and Windows have no such file"""

# One flag per instruction set that multiplies bfloat16: x86 with AVX-512 or AMX, and ARM.
_BF16_FLAGS = frozenset({"avx512_bf16", "amx_bf16", "bf16"})


def usable_cores() -> int:
    """Return the number of cores that this process may use, which `taskset` or a container can limit."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor_name(cpuinfo: Path = CPUINFO) -> str:
    """Return the processor's name.

    Args:
        cpuinfo: file in the format of Linux's ``/proc/cpuinfo``. Where it is absent or has no name, as on ARM, the
            name is what Python's `platform` module knows, at least the architecture.
    """
    names = _values(cpuinfo, "model name")
    return names[0] if names else platform.processor() or platform.machine()


def cpu_flags(cpuinfo: Path = CPUINFO) -> frozenset[str]:
    """Return the names of the processor's instruction sets, as Linux writes them (``avx2``, ``asimd``, ...).

    Args:
        cpuinfo: file in the format of Linux's ``/proc/cpuinfo``; without it the set is empty, since other systems do
            not list them.
    """
    # x86 has "flags", ARM "Features".
    return frozenset(flag for key in ("flags", "Features") for line in _values(cpuinfo, key) for flag in line.split())


def has_bf16(cpuinfo: Path = CPUINFO) -> bool:
    """Return whether the processor is known to multiply bfloat16 in hardware; False where the system does not say."""
    return bool(cpu_flags(cpuinfo) & _BF16_FLAGS)


def _values(cpuinfo: Path, wanted: str) -> list[str]:
    """Return what a key stands for, once per logical processor; empty where the file cannot be read."""
    try:
        lines = cpuinfo.read_text(errors="replace").splitlines()
    except OSError:
        return []
    pairs = (line.partition(":") for line in lines)
    return [value.strip() for key, _, value in pairs if key.strip() == wanted and value.strip()]
