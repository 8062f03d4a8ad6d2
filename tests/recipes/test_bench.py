"""What `bench` times, on a machine whose engines are stand-ins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.speed import Candidate
from psiamfcpp.recipes import bench as recipe
from psiamfcpp.recipes.bench import BenchResult
from psiamfcpp.watch import Watch


@dataclass
class FakeEngine:
    name: str
    device: str
    precision: str


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, str]]:
    """Every tracker that is opened, on a machine with one GPU."""
    seen: list[tuple[str, str, str]] = []

    class FakeTracker:
        def __init__(self, model: str, options: Any) -> None:
            seen.append((model, options.engine, options.device))
            if options.device == "cuda" and model == "siamfcpp-alexnet":
                raise UserError("device cuda: torch finds no GPU")
            device = "cuda:0" if options.device == "cuda" else "cpu"
            self.engine = FakeEngine(options.engine, device, "int8" if model.endswith("int8") else "fp32")

    monkeypatch.setattr(recipe, "Tracker", FakeTracker)
    monkeypatch.setattr("psiamfcpp.evaluation.speed.OurTracker", FakeTracker)
    return seen


def test_the_table_is_of_what_the_trackers_say_of_themselves(opened: list[tuple[str, str, str]]) -> None:
    said: list[str] = []
    models = ("psiamfcpp-alexnet", "psiamfcpp-alexnet-int8")
    found = recipe._ours(models, ("onnx",), ("cpu", "cuda"), 1, Watch(said.append))
    assert [(c.model, c.engine, c.device, c.precision) for c in found] == [
        ("psiamfcpp-alexnet", "onnx", "cpu", "fp32"),
        ("psiamfcpp-alexnet", "onnx", "cuda:0", "fp32"),
        ("psiamfcpp-alexnet-int8", "onnx", "cpu", "int8"),
    ]
    assert said == [
        "left out: psiamfcpp-alexnet-int8 on cuda: 8-bit graphs are made for processors, time the float model there"
    ]


def test_a_device_that_is_only_tried_may_be_missing(
    opened: list[tuple[str, str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recipe, "usable_devices", lambda: ["cpu", "cuda"])
    said: list[str] = []
    found = recipe._ours(("siamfcpp-alexnet",), ("torch",), (), 1, Watch(said.append))
    assert [(c.model, c.device) for c in found] == [("siamfcpp-alexnet", "cpu")]
    assert said == ["left out: device cuda: torch finds no GPU"]
    with pytest.raises(UserError, match="torch finds no GPU"):
        recipe._ours(("siamfcpp-alexnet",), ("torch",), ("cuda",), 1, Watch())


def test_engines_are_not_tried_on_devices_that_they_do_not_know(opened: list[tuple[str, str, str]]) -> None:
    recipe._ours(("psiamfcpp-alexnet",), (), ("cuda",), 1, Watch())
    assert {engine for _, engine, _ in opened} == {"onnx", "torch"}


def row(model: str, engine: str, device: str | None, ms: float) -> dict[str, Any]:
    return {"model": model, "engine": engine, "device": device, "ms_median": ms}


def test_a_model_has_the_speed_of_its_fastest_engine_on_each_processor() -> None:
    result = BenchResult(
        [row("a", "torch", "cpu", 40), row("a", "onnx", "cpu", 20), row("a", "torch", "cuda:0", 4),
         row("b", "onnx", "cpu", 10), row("mil", "opencv", None, 5)],
        {},
    )  # fmt: skip
    assert result.processors == [
        {"model": "a", "fps_cpu": 50, "fps_gpu": 250},
        {"model": "b", "fps_cpu": 100, "fps_gpu": None},
    ]


def test_a_tracker_of_others_has_its_kind_for_an_engine() -> None:
    assert Candidate("opencv-mil", tracker=None, kind="opencv").engine == "opencv"  # type: ignore[arg-type]
