"""`psiamfcpp bench`: what it times, says and refuses; never how long something took."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from psiamfcpp.evaluation.speed import Bench, Candidate, Step, Timing

from .conftest import Run

ROW = {
    "model",
    "engine",
    "device",
    "precision",
    "ms_median",
    "ms_min",
    "ms_spread",
    "speedup",
    "crop_ms",
    "graph_ms",
    "decode_ms",
}


def timing(name: str, *rounds: list[float]) -> Timing:
    """Updates of so many milliseconds, nine tenths of it in the graph."""
    steps = [[Step(ms * 0.05e-3, ms * 0.9e-3, ms * 0.05e-3) for ms in updates] for updates in rounds]
    return Timing(Candidate(name, tracker=None), steps)  # type: ignore[arg-type]


def test_speedup_is_the_median_over_rounds_of_what_each_round_saw() -> None:
    # the third round met a machine half as fast, for both: its ratio is the same
    slow = timing("slow", [100, 101, 99], [100, 90, 120], [200, 210, 190])
    fast = timing("fast", [20, 20, 80], [25, 25, 25], [40, 39, 41])
    row = fast.row(slow)
    assert row["speedup"] == pytest.approx(5.0)  # of 5, 4 and 5
    assert row["ms_median"] == pytest.approx(25)
    assert row["ms_min"] == pytest.approx(20)
    assert row["ms_spread"] == pytest.approx(20)
    assert row["graph_ms"] == pytest.approx(0.9 * 25)
    assert fast.row(None)["speedup"] is None


@pytest.mark.parametrize(("reference", "noisy"), [([2.0, 2.0, 2.1], False), ([2.0, 2.5, 2.6], True), ([2.0], False)])
def test_a_machine_whose_fixed_work_varies_is_noisy(reference: list[float], noisy: bool) -> None:
    assert Bench([], reference=reference).noisy is noisy


@pytest.mark.slow
def test_rows_for_programs(run: Run, tiny_graphs: Path) -> None:
    ended = run("bench", "--models", tiny_graphs, "--engines", "onnx", "--rounds", 2, "--frames", 2, "--json")
    assert ended.code == 0, ended.err
    told = json.loads(ended.out)
    ours, *peers = told["rows"]
    assert all(set(row) == ROW for row in told["rows"])
    assert (ours["model"], ours["engine"], ours["precision"]) == (str(tiny_graphs), "onnx", "fp32")
    assert (ours["device"], peers[0]["device"]) == ("cpu", None)
    assert [(row["model"], row["engine"]) for row in peers] == [("opencv-mil", "opencv")]
    assert told["rounds"] == 2
    assert told["frame_size"] == [1280, 720]
    (columns,) = told["processors"]
    assert columns["fps_cpu"] == pytest.approx(1e3 / ours["ms_median"])
    assert columns["fps_gpu"] is None
    assert {"cpu", "flags", "threads", "load", "noise", "noisy", "read_ms"} <= set(told)


@pytest.mark.slow
def test_a_sequence_of_frames_is_followed(run: Run, tiny_graphs: Path, blob_sequence) -> None:
    root = blob_sequence("blob", [(100 + i, 80, 40, 30) for i in range(3)])
    args = ("bench", "--models", tiny_graphs, "--engines", "onnx", "--rounds", 1, "--threads", 1)
    ended = run(*args, "--frames", 2, "--sequence", root / "blob")
    assert ended.code == 0, ended.err
    assert "frames of 320x240" in ended.out
    assert ended.out.splitlines()[-1].endswith("not measured")
    assert "holds 3 frames" in run(*args, "--frames", 3, "--sequence", root / "blob").refused()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--rounds", "0"), "rounds is 0"),
        (("--threads", "0"), "threads is 0"),
        (("--engines", "tensorflow"), "unknown engine 'tensorflow'"),
        (("--devices", "cuda:x"), "unknown device 'cuda:x'"),
        (("--models", "siamfcpp-alexnet", "--engines", "openvino", "--devices", "cuda"), "no model and engine"),
        (("--models", "siamfcpp-alexnt", "--engines", "torch"), "did you mean 'siamfcpp-alexnet'"),
        (("--models", "siamfcpp-alexnet-int8", "--engines", "torch"), "no model and engine go together"),
    ],
)
def test_wrong_options_are_refused(run: Run, options: tuple[str, ...], message: str) -> None:
    assert message in run("bench", *options).refused()


def test_a_missing_peer_is_named(run: Run, tiny_graphs: Path) -> None:
    args = ("bench", "--models", tiny_graphs, "--engines", "onnx", "--rounds", 1, "--frames", 1)
    refused = run(*args, "--tracker", "opencv:vit,net=nowhere.onnx").refused()
    assert "model file 'nowhere.onnx' of TrackerVit does not exist" in refused
