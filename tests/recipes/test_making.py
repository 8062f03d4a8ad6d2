"""Making models from Python: what recipes return, and that they leave nothing behind unless asked to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from psiamfcpp.errors import UserError
from psiamfcpp.models import load
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.pruning import Context, Group, Plan
from psiamfcpp.recipes import calibrate, export, plan, prune, rank, scoring


@pytest.fixture
def clips(blob_sequence: Callable[..., Path]) -> Path:
    blob_sequence("blob", [(90.0 + 3 * t, 80.0, 40, 30) for t in range(3)])
    return blob_sequence("other", [(120.0, 80.0 + 3 * t, 30, 36) for t in range(3)])


@pytest.mark.slow
def test_from_a_ranking_to_graphs_without_a_file_in_between(tiny_model: Path, clips: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    data, before = [f"folder:{clips}"], set(tmp_path.rglob("*"))
    ranks = rank.rank(tiny_model, data, images=2, held_out_every=0)
    assert ranks.images == 2 and ranks.widths == dict.fromkeys(ARCHITECTURE.groups, 8)
    assert set(rank.summary(ranks)) == set(ARCHITECTURE.groups)
    planned = plan.plan(ranks, keep={"head.reg1": 0.5})
    assert planned.plan.widths == {**dict.fromkeys(ARCHITECTURE.groups, 8), "head.reg1": 4} == planned.after["widths"]
    assert planned.before["parameters"] > planned.after["parameters"] and planned.times is None
    pruned = prune.prune(tiny_model, planned.plan, data=data, images=2, held_out_every=0)
    assert pruned.after == planned.after
    (step,) = pruned.network.spec.provenance["pruning"]
    assert (step["from"], step["plan"], step["refit"]["images"]) == (tiny_model.name, None, 2)
    assert set(tmp_path.rglob("*")) == before
    done = export.export(tiny_model, tmp_path / "graphs", pairs=4)
    assert done.crops == 4 and not done.by_layer and done.difference.scores < 1e-3


def test_a_criterion_may_be_a_function(tiny_model: Path) -> None:
    seen: list[tuple[str, bool]] = []

    def first(group: Group, context: Context) -> np.ndarray:
        seen.append((group.name, context.ranks is None and context.gradients is None))
        assert torch.is_tensor(context.example_inputs[0]) and len(list(context.model.parameters()))
        return np.arange(group.width, 0, -1)

    table = scoring.score_model(load(tiny_model), first)
    assert table.about["criterion"] == "first" and seen == [(name, True) for name in ARCHITECTURE.groups]
    assert plan.plan(table, remove=0.75, flat=True).plan.keep == {name: [0, 1] for name in ARCHITECTURE.groups}


def test_the_architecture_of_a_table_decides_its_groups(tiny_model: Path) -> None:
    table = scoring.score_model(tiny_model, "norm")
    assert plan.spec_of(table).architecture == "siamfcpp-alexnet"
    table.about["architecture"] = "resnet"  # type: ignore[index]
    with pytest.raises(UserError, match="unknown architecture 'resnet'"):
        plan.plan(table, remove=0.5)


def test_presets_are_those_of_the_architecture(tiny_model: Path) -> None:
    table = scoring.score_model(tiny_model, "norm")
    assert plan.plan(table, preset="paper").plan.widths["head.cls2"] == 4
    with pytest.raises(UserError, match="unknown preset 'papr': siamfcpp-alexnet has paper"):
        plan.plan(table, preset="papr")


def test_plans_for_another_network_are_refused(tiny_model: Path) -> None:
    with pytest.raises(UserError, match=r"the plan lacks backbone\.conv1"):
        prune.prune(tiny_model, Plan({"head.cls1": [0]}))


def test_a_network_that_finds_nothing_cannot_be_calibrated(tiny_model: Path, clips: Path) -> None:
    with pytest.raises(UserError, match="0 clips held out by 0"):
        calibrate.calibrate(tiny_model, clips, held_out_every=0)
    notes: list[str] = []
    with pytest.raises(UserError, match="finds nothing"):
        calibrate.calibrate(tiny_model, clips, held_out_every=1, watch=calibrate.Watch(notes.append))
    assert notes == ["looking at 2 clips"]
