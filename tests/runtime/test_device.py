"""Devices: what names one, and what does not."""

from __future__ import annotations

import pytest

from psiamfcpp import UserError
from psiamfcpp.runtime.device import CPU, Device, parse_device


@pytest.mark.parametrize(
    ("text", "device", "shown"),
    [
        ("cpu", CPU, "cpu"),
        ("cuda", Device("cuda", 0), "cuda:0"),
        ("cuda:0", Device("cuda", 0), "cuda:0"),
        ("cuda:12", Device("cuda", 12), "cuda:12"),
        ("tensorrt", Device("tensorrt", 0), "tensorrt:0"),
        ("tensorrt:1", Device("tensorrt", 1), "tensorrt:1"),
    ],
)
def test_a_device_is_named_and_shown(text: str, device: Device, shown: str) -> None:
    assert parse_device(text) == device
    assert str(device) == shown
    assert parse_device(shown) == device


@pytest.mark.parametrize(
    "text", ["", "gpu", "CUDA", "cpu:0", "cuda:", "cuda:-1", "cuda:1.0", "cuda:²", "cuda:1\n", "cuda 1"]
)
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(UserError, match=r"unknown device .*known are cpu, cuda and tensorrt"):
        parse_device(text)
