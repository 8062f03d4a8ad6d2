"""torch on a GPU, as far as can be seen without one: what is refused, and half precision on the processor."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from psiamfcpp import UserError
from psiamfcpp.crop import mean_colour, target_crop
from psiamfcpp.demo.clip import DemoFrame
from psiamfcpp.geometry import centre
from psiamfcpp.models import load
from psiamfcpp.models.network import ConvBlock
from psiamfcpp.runtime import open_engine, torch_engine
from psiamfcpp.runtime.device import Device
from psiamfcpp.runtime.torch_engine import TorchEngine, in_half, torch_device


@pytest.fixture(autouse=True)
def threads_as_before() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("built_for", "available", "count", "message"),
    [
        (None, False, 0, r"device cuda:2: the installed torch .* is built without CUDA: .*pytorch\.org"),
        ("13.0", False, 0, "device cuda:2: torch finds no GPU: check the driver with nvidia-smi"),
        ("13.0", True, 2, "device cuda:2: torch finds 2 of them, numbered from 0"),
    ],
)
def test_a_gpu_that_is_not_there_is_refused(
    tiny_model: Path,
    monkeypatch: pytest.MonkeyPatch,
    built_for: str | None,
    available: bool,
    count: int,
    message: str,
) -> None:
    monkeypatch.setattr(torch.version, "cuda", built_for)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: available)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    with pytest.raises(UserError, match=message):
        open_engine(str(tiny_model), "torch", device="cuda:2")


@pytest.mark.parametrize(("text", "expected"), [("cpu", "cpu"), ("cuda", "cuda:1")])
def test_a_gpu_that_is_there_is_taken_by_its_number(monkeypatch: pytest.MonkeyPatch, text: str, expected: str) -> None:
    # A build for AMD says is_available() and names no version of CUDA.
    monkeypatch.setattr(torch.version, "cuda", None)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert torch_device(Device(text, 1)) == torch.device(expected)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_gpu_computes_in_half_precision(tiny_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = open_engine(str(tiny_model), "torch", 1)
    monkeypatch.setattr(torch_engine, "torch_device", lambda device: torch.device("cpu"))
    half = open_engine(str(tiny_model), "torch", 1, device="cuda")
    assert (full.device, full.precision, half.device, half.precision) == ("cpu", "fp32", "cuda:0", "fp16")
    rng = np.random.default_rng(0)
    crops = rng.integers(0, 256, (2, 303, 303, 3), np.uint8)
    z = np.ascontiguousarray(crops[0, :127, :127])
    kernels = half.template(z)
    assert {kernel.dtype for kernel in kernels} == {torch.float16}
    scores, boxes = half.search(crops[0], kernels)
    assert scores.dtype == boxes.dtype == np.float32
    expected_scores, expected_boxes = full.search(crops[0], full.template(z))
    # half precision has 11 bits; boxes are in pixels of the crop
    assert_allclose(scores, expected_scores, atol=2e-3)
    assert_allclose(boxes, expected_boxes, atol=0.5)
    many, _ = half.search_many(crops, [kernels, kernels])
    assert_allclose(many[0], scores, atol=2e-3)


@pytest.mark.slow
def test_a_trained_model_finds_the_same_boxes_in_half_precision(
    rendered_clip: list[DemoFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    full = open_engine("psiamfcpp-alexnet-s", "torch", 1, 239)
    monkeypatch.setattr(torch_engine, "torch_device", lambda device: torch.device("cpu"))
    half = open_engine("psiamfcpp-alexnet-s", "torch", 1, 239, "cuda")
    shots = (rendered_clip[0], rendered_clip[2])
    z, x = (
        target_crop(shot.image, (*map(float, centre(shot.box)), *shot.box[2:]), side, 127, mean_colour(shot.image))
        for shot, side in zip(shots, (127, 239), strict=True)
    )
    (scores, boxes), (expected_scores, expected_boxes) = (e.search(x, e.template(z)) for e in (half, full))
    assert_allclose(scores, expected_scores, atol=2e-3)
    counts = expected_scores >= expected_scores.max() / 2
    # what docs/export.md states, in pixels of the search crop
    assert_allclose(boxes[counts], expected_boxes[counts], atol=0.5)


def test_variances_beyond_half_precision_are_folded_before(tiny_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network = load(tiny_model)
    for block in network.modules():
        if isinstance(block, ConvBlock) and block.bn is not None:
            block.conv.weight.data *= 1000.0
            assert block.bn.running_var is not None
            block.bn.running_var.fill_(1e6)  # half precision ends at 65,504
    full = TorchEngine(network, 1)
    monkeypatch.setattr(torch_engine, "torch_device", lambda device: torch.device("cpu"))
    half = TorchEngine(network, 1, device=Device("cuda"))
    rng = np.random.default_rng(0)
    z, x = (rng.integers(0, 256, (side, side, 3), np.uint8) for side in (127, 303))
    for found, expected in zip(half.search(x, half.template(z)), full.search(x, full.template(z)), strict=True):
        assert_allclose(found, expected, atol=0.5)


def test_the_network_of_the_caller_stays_as_it_is(tiny_model: Path) -> None:
    network = load(tiny_model)
    before = {key: value.clone() for key, value in network.state_dict().items()}
    halved = in_half(network)
    after = network.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[key], after[key]) for key in before)
    assert torch.float16 in {p.dtype for p in halved.parameters()}
    assert {p.dtype for p in network.parameters()} == {torch.float32}
