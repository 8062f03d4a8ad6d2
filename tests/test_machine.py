"""Machine facts: what two kinds of /proc/cpuinfo say, and what is said where there is none."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import pytest

from psiamfcpp import machine

X86 = """\
processor\t: 0
vendor_id\t: GenuineIntel
model\t\t: 143
model name\t: Intel(R) Xeon(R) Platinum: 8480+
flags\t\t: fpu avx2 fma avx512f {extra}
bugs\t\t: spectre_v1 avx512_bf16_erratum

processor\t: 1
vendor_id\t: GenuineIntel
model name\t: Intel(R) Xeon(R) Platinum: 8480+
flags\t\t: fpu avx2 fma avx512f {extra}
"""
ARM = """\
processor\t: 0
BogoMIPS\t: 108.00
Features\t: fp asimd {extra}
CPU implementer\t: 0x41

Model\t\t: Raspberry Pi 5 Model B Rev 1.0
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "cpuinfo"
    path.write_text(text)
    return path


def test_an_x86_processor_has_a_name_and_flags(tmp_path: Path) -> None:
    cpuinfo = written(tmp_path, X86.format(extra="amx_int8"))
    assert machine.processor_name(cpuinfo) == "Intel(R) Xeon(R) Platinum: 8480+"
    assert machine.cpu_flags(cpuinfo) == {"fpu", "avx2", "fma", "avx512f", "amx_int8"}


def test_an_arm_processor_has_flags_and_the_name_that_the_platform_gives(tmp_path: Path) -> None:
    cpuinfo = written(tmp_path, ARM.format(extra="i8mm"))
    assert machine.cpu_flags(cpuinfo) == {"fp", "asimd", "i8mm"}
    assert machine.processor_name(cpuinfo) == (platform.processor() or platform.machine())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (X86.format(extra=""), False),  # the erratum's name is no flag
        (X86.format(extra="avx512_bf16"), True),
        (X86.format(extra="amx_bf16"), True),
        (X86.format(extra="avx512_vnni"), False),
        (ARM.format(extra="bf16"), True),
        (ARM.format(extra="sve"), False),
        ("", False),
    ],
)
def test_bfloat16_is_a_flag_of_its_own(tmp_path: Path, text: str, expected: bool) -> None:
    assert machine.has_bf16(written(tmp_path, text)) is expected


def test_where_the_system_lists_nothing_nothing_is_claimed(tmp_path: Path) -> None:
    absent = tmp_path / "absent"
    assert machine.cpu_flags(absent) == frozenset()
    assert machine.has_bf16(absent) is False
    assert machine.processor_name(absent) == (platform.processor() or platform.machine())


@pytest.mark.parametrize(("counted", "expected"), [(6, 6), (None, 1)])
def test_without_affinity_all_cores_count(monkeypatch: pytest.MonkeyPatch, counted: int | None, expected: int) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: counted)
    assert machine.usable_cores() == expected


def test_affinity_limits_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {3, 5}, raising=False)
    assert machine.usable_cores() == 2
