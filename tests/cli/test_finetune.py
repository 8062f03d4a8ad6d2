"""`psiamfcpp train` from a pruned model, with the paper's schedule and with the unpruned one as teacher."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from psiamfcpp.models import SiamFCpp, load, save
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.spec import ModelSpec

from .conftest import Run

PAPER = "--optimizer sgd --lr 0.08 --warmup 0.05 --final-lr 1.25e-5 --weight-decay 5e-5 --ema 0"
QUICK = "--steps 3 --batch 2 --search-size 191 --workers 0 --no-bf16 --held-out-every 0"


@pytest.mark.slow
def test_a_pruned_model_learns_from_the_unpruned_one(
    run: Run, tiny_model: Path, blob_sequence: Callable[..., Path], tmp_path: Path
) -> None:
    clips = blob_sequence("blob", [(90.0 + 3 * t, 80.0, 40, 30) for t in range(3)])
    blob_sequence("other", [(120.0, 80.0 + 3 * t, 30, 36) for t in range(3)])
    pruned = tmp_path / "pruned.safetensors"
    widths = {name: 2 + number % 5 for number, name in enumerate(ARCHITECTURE.groups)}
    save(pruned, SiamFCpp(ModelSpec(widths=widths, provenance={"pruning": [{"plan": "x"}]})))
    output = tmp_path / "run"
    ended = run(
        "train", "--data", f"folder:{clips}", "--init", pruned, "--teacher", tiny_model, "-o", output,
        *PAPER.split(), *QUICK.split(),
    )  # fmt: skip
    assert ended.code == 0, ended.err
    assert "teacher" in ended.err.splitlines()[-1]
    spec = load(output / "model.safetensors").spec
    assert spec.widths == widths
    assert spec.provenance["pruning"] == [{"plan": "x"}]
    (stage,) = spec.provenance["training"]
    assert stage["options"]["teacher"] == {
        "teacher": tiny_model.name,
        "teacher_weight": 1.0,
        "teacher_features": 0.0,
    }
    assert str(tmp_path) not in json.dumps(spec.provenance)
