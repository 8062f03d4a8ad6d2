"""Training as users start it: a process that is killed, and two that share the work. These take some seconds each."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from psiamfcpp.cli import main
from psiamfcpp.models import SiamFCpp, load, save
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.spec import ModelSpec

DEADLINE = 900.0
# The command, killed from within right after its first row of the log: from outside it may be over before it is hit.
KILLED = """
import contextlib, os, signal, sys
from psiamfcpp.cli import main
from psiamfcpp.training import loop
@contextlib.contextmanager
def writing(path):
    yield
    os.kill(os.getpid(), signal.SIGKILL)
loop.writing = writing
main(sys.argv[1:])
"""
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def init(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("init") / "narrow.safetensors"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        save(path, SiamFCpp(ModelSpec(widths=dict.fromkeys(ARCHITECTURE.groups, 6))))
    return path


def arguments(clips: Path, init: Path, output: Path, steps: int, *more: str) -> list[str]:
    given = ["train", "--data", f"folder:{clips}", "--init", str(init), "-o", str(output), "--steps", str(steps)]
    given += ["--batch", "2", "--search-size", "191", "--workers", "0", "--validation-pairs", "8", "--no-bf16"]
    return [*given, "--held-out-every", "7", *more]


def steps_logged(output: Path) -> list[int]:
    return [json.loads(line)["step"] for line in (output / "log.jsonl").read_text().splitlines()]


def test_a_killed_process_is_continued_to_the_same_end(clip_folder: Path, init: Path, tmp_path: Path):
    output = tmp_path / "run"
    command = arguments(clip_folder, init, output, 60, "--save-every", "40")
    killed = subprocess.run([sys.executable, "-c", KILLED, *command], capture_output=True, timeout=DEADLINE)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert steps_logged(output) == [50]
    assert torch.load(output / "state.pt", weights_only=True)["step"] == 40

    # In processes of their own: the bits depend on the number of threads, which other tests change.
    subprocess.run([sys.executable, "-m", "psiamfcpp", *command], check=True, capture_output=True)
    assert steps_logged(output) == [50, 60]
    assert (output / "curve.png").read_bytes().startswith(b"\x89PNG")

    straight = tmp_path / "straight"
    again = arguments(clip_folder, init, straight, 60)
    subprocess.run([sys.executable, "-m", "psiamfcpp", *again], check=True, capture_output=True)
    assert (output / "model.safetensors").read_bytes() == (straight / "model.safetensors").read_bytes()


def test_two_processes_share_the_work(clip_folder: Path, init: Path, tmp_path: Path):
    output = tmp_path / "run"
    output.mkdir()
    (output / "log.jsonl").write_text('{"step": 3}\n')  # of a run killed before its first state
    launch = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "psiamfcpp"]
    done = subprocess.run(
        [sys.executable, *launch, *arguments(clip_folder, init, output, 4, "--conv5", "0.5")],
        capture_output=True,
        text=True,
        timeout=DEADLINE,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in output.iterdir()) == ["curve.png", "log.jsonl", "model.safetensors", "state.pt"]
    assert steps_logged(output) == [4]
    assert done.stderr.count("step 4/4") == 1
    trained, before = load(output / "model.safetensors"), load(init)
    assert not torch.equal(trained.backbone.conv5.conv.weight, before.backbone.conv5.conv.weight)
    assert torch.equal(trained.backbone.conv1.conv.weight, before.backbone.conv1.conv.weight)


def test_a_shipped_model_is_a_start_by_its_name(clip_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    output = tmp_path / "run"
    assert main(arguments(clip_folder, Path("siamfcpp-alexnet"), output, 1, "--lr", "1e-9")) == 0
    stages = load("siamfcpp-alexnet").spec.provenance["training"]
    assert [s["init"] for s in load(output / "model.safetensors").spec.provenance["training"]] == [
        *(s["init"] for s in stages),
        "siamfcpp-alexnet",
    ]
    assert main(arguments(clip_folder, Path("siamfcpp-alexnt"), tmp_path / "other", 1)) == 2
    assert "did you mean 'siamfcpp-alexnet'?" in capsys.readouterr().err
