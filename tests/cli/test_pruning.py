"""`psiamfcpp rank`, `plan` and `prune`, one feeding the next."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from psiamfcpp.models import load
from psiamfcpp.models.arch import architecture
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE

from .conftest import Run

PAPER = [76, 224, 337, 334, 256, 256, 256, 230, 138, 224, 227, 145, 224]


@pytest.fixture
def clips(blob_sequence: Callable[..., Path]) -> Path:
    for number in range(3):
        root = blob_sequence(
            f"blob{number}", [(90.0 + 20 * number + 3 * t, 80.0 + 5 * t, 40, 30 + number) for t in range(4)]
        )
    return root


@pytest.fixture
def full_table(tmp_path: Path) -> Path:
    """A rank table of the unpruned network, its ranks a shuffled 1, 2, 3 ... and the necks' and conv5's alike."""
    rng = np.random.default_rng(0)
    flat = ("backbone.conv5", "neck.cls", "neck.reg")
    groups = {
        name: {"rank": [28.0] * width if name in flat else [float(r) for r in rng.permutation(width) + 1], "max": 999}
        for name, width in ARCHITECTURE.groups.items()
    }
    path = tmp_path / "full.json"
    path.write_text(json.dumps({"format": "psiamfcpp-ranks/1", "images": 9, "groups": groups}))
    return path


@pytest.mark.slow
def test_rank_plan_prune_and_follow(run: Run, tiny_model: Path, clips: Path, tmp_path: Path) -> None:
    ranks, plan, pruned = tmp_path / "ranks.json", tmp_path / "plan.json", tmp_path / "pruned.safetensors"
    ended = run("rank", tiny_model, "--data", f"folder:{clips}", "-o", ranks, "--images", 6, "--batch", 4, "--json")
    assert (ended.code, ended.err) == (0, "")
    facts = json.loads(ended.out)
    table = json.loads(ranks.read_text())
    assert (facts["images"], table["images"], table["search_size"]) == (6, 6, 303)
    assert list(facts["groups"]) == list(table["groups"]) == list(ARCHITECTURE.groups)
    assert "2**-23" in table["tolerance"]
    conv1 = table["groups"]["backbone.conv1"]
    assert (conv1["max"], conv1["template"]["max"], conv1["search"]["max"]) == (103, 59, 147)
    assert conv1["rank"] == pytest.approx(
        [(z + x) / 2 for z, x in zip(conv1["template"]["rank"], conv1["search"]["rank"], strict=True)], abs=1e-5
    )
    assert [row["images"] for row in table["stability"]["head.cls3"]] == [6]
    assert ranks.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert all(facts["groups"][name]["dead"] == table["groups"][name]["rank"].count(0) for name in ARCHITECTURE.groups)

    text = run("plan", ranks, "--keep", "backbone.conv2=0.5", "head.reg1=0.25", "-o", plan)
    assert text.code == 0
    keep = json.loads(plan.read_text())["keep"]
    assert {name: len(filters) for name, filters in keep.items()} == {
        **dict.fromkeys(ARCHITECTURE.groups, 8),
        "backbone.conv2": 4,
        "head.reg1": 2,
    }

    facts = json.loads(run("prune", tiny_model, "--plan", plan, "-o", pruned, "--json").out)
    described = json.loads(run("info", pruned, "--json").out)
    for key in ("parameters", "gmacs", "widths"):
        assert facts["after"][key] == described[key]
    assert facts["before"]["widths"]["head.reg1"] == 8 and facts["after"]["widths"]["head.reg1"] == 2
    (step,) = described["provenance"]["pruning"]
    assert step["from"] == tiny_model.name and step["plan"] == "plan.json"
    assert run("evaluate", "--root", clips, "--tracker", pruned, "--json").code == 0

    fitted = tmp_path / "fitted.safetensors"
    prune = ("prune", tiny_model, "--plan", plan, "--data", f"folder:{clips}")
    again = run(*prune, "-o", fitted, "--images", 3, "--json")
    assert (again.code, again.err) == (0, "")
    assert json.loads(again.out) == facts
    (step,) = json.loads(run("info", fitted, "--json").out)["provenance"]["pruning"]
    assert step["refit"] == {"data": [f"folder:{clips.name}"], "images": 3, "seed": 0, "held_out_every": 10}
    old, new = load(pruned).state_dict(), load(fitted).state_dict()
    # conv2 was the first to be cut, so conv3 is the first that has something to make up for
    conv2, conv3 = (f"backbone.conv{i}.conv.weight" for i in (2, 3))
    assert torch.equal(old[conv2], new[conv2]) and not torch.equal(old[conv3], new[conv3])
    # every clip kept out leaves none to draw from
    none = (*prune, "-o", tmp_path / "none.safetensors", "--held-out-every", 1)
    assert "nothing is left of the data" in run(*none).refused()
    assert "images is 0" in run(*prune, "-o", tmp_path / "none.safetensors", "--images", 0).refused()
    assert not (tmp_path / "none.safetensors").exists()
    assert "no folder" in run(*prune, "-o", tmp_path / "missing" / "fitted.safetensors").refused()


@pytest.mark.slow
def test_ranking_goes_on_after_a_kill_and_with_more_images(
    run: Run, tiny_model: Path, clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rank(folder: str, images: int) -> Any:
        (tmp_path / folder).mkdir(exist_ok=True)
        output = tmp_path / folder / "ranks.json"
        ended = run("rank", tiny_model, "--data", f"folder:{clips}", "-o", output, "--images", images, "--batch", 2)
        return ended, output

    _, straight = rank("straight", 6)

    from psiamfcpp.training import pairs

    drawn: list[int] = []
    pair = pairs.PairSampler.pair

    def die_at_four(self: pairs.PairSampler, index: int) -> pairs.Pair:
        drawn.append(index)
        if index == 4 and drawn.count(4) == 1:
            raise KeyboardInterrupt
        return pair(self, index)

    monkeypatch.setattr(pairs.PairSampler, "pair", die_at_four)
    ended, resumed = rank("resumed", 6)
    assert ended.code == 130 and not resumed.exists()
    ended, resumed = rank("resumed", 6)
    assert "4 pairs of crops are ranked already" in ended.err
    assert drawn == [0, 1, 2, 3, 4, 4, 5]
    assert resumed.read_bytes() == straight.read_bytes()

    _, more = rank("resumed", 8)
    assert drawn[7:] == [6, 7]
    assert json.loads(more.read_text())["images"] == 8


@pytest.mark.slow
def test_ranks_of_another_seed_are_not_taken_up(run: Run, tiny_model: Path, clips: Path, tmp_path: Path) -> None:
    args = ("rank", tiny_model, "--data", f"folder:{clips}", "-o", tmp_path / "ranks.json", "--images", 2)
    assert run(*args).code == 0
    assert "another seed" in run(*args, "--seed", 1).refused()
    (tmp_path / "ranks.npz").write_bytes(b"PK")
    assert "remove it to begin anew" in run(*args).refused()


def test_the_papers_plan(run: Run, full_table: Path) -> None:
    facts = json.loads(run("plan", full_table, "--preset", "paper", "--json").out)
    assert (facts["before"]["parameters"], facts["after"]["parameters"]) == (9_655_380, 7_489_986)
    assert facts["before"]["gmacs"] == pytest.approx(8.56, abs=0.005)
    assert facts["after"]["gmacs"] == pytest.approx(6.47, abs=0.005)
    assert list(facts["after"]["widths"].values()) == PAPER
    text = run("plan", full_table, "--preset", "paper").out
    assert "9,655,380 -> 7,489,986" in text
    # Ranks 1, 2 ... 96: the 20 lowest go.
    assert text.splitlines()[1].split() == ["backbone.conv1", "76", "20", "20.00", "0"]
    assert text.splitlines()[5].split() == ["backbone.conv5", "256", "0", "-", "0", "flat"]


def test_thresholds_give_the_papers_widths(run: Run, full_table: Path) -> None:
    limits = [f"{n}={w - k}" for (n, w), k in zip(ARCHITECTURE.groups.items(), PAPER, strict=True) if k < w]
    facts = json.loads(run("plan", full_table, "--threshold", *limits, "--json").out)
    assert list(facts["after"]["widths"].values()) == PAPER


def test_remove_leaves_flat_groups_whole_unless_told(run: Run, full_table: Path) -> None:
    widths = json.loads(run("plan", full_table, "--remove", "0.25", "--json").out)["after"]["widths"]
    assert (widths["backbone.conv1"], widths["backbone.conv5"], widths["neck.cls"]) == (72, 256, 256)
    assert "flat" in run("plan", full_table, "--remove", "0.25", "--flat").refused()
    data = json.loads(full_table.read_text())
    for group in data["groups"].values():
        group["norm"] = list(range(len(group["rank"])))
    full_table.write_text(json.dumps(data))
    ended = run("plan", full_table, "--remove", "0.25", "--flat", "--json")
    assert json.loads(ended.out)["after"]["widths"]["backbone.conv5"] == 192
    assert [line.split(":")[0] for line in ended.err.splitlines()] == ["backbone.conv5", "neck.cls", "neck.reg"]
    assert "weight norm" in ended.err


@pytest.mark.parametrize("share", [0.3, 0.7, 1.0])
def test_a_budget_of_multiply_accumulates_is_met_closely(run: Run, full_table: Path, share: float) -> None:
    facts = json.loads(run("plan", full_table, "--target-macs", share, "--json").out)
    assert share - 0.03 < facts["after"]["gmacs"] / facts["before"]["gmacs"] <= share
    assert facts["after"]["widths"]["neck.cls"] == 256


@pytest.mark.slow
def test_a_budget_of_time_halves_its_way(run: Run, full_table: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from psiamfcpp.models.cost import search_macs
    from psiamfcpp.recipes import plan

    # A machine that takes 10 ms a GMAC.
    monkeypatch.setattr(plan, "milliseconds", lambda spec, timing: search_macs(spec) / 1e8)
    ended = run("plan", full_table, "--target-latency", 50, "--threads", 3, "--json")
    facts = json.loads(ended.out)
    assert 4.7 < facts["after"]["gmacs"] <= 5
    assert facts["times"] == {
        "before": pytest.approx(85.6, abs=0.1),
        "after": pytest.approx(facts["after"]["gmacs"] * 10),
        "engine": "onnx",
        "precision": "int8",
        "threads": 3,
    }
    assert "timing int8 graphs in onnx on 3 threads" in ended.err.splitlines()[0]
    assert (
        "ms a search crop, int8 graphs in onnx on 3 threads"
        in run("plan", full_table, "--target-latency", 1000, "--threads", 3).out.splitlines()[-1]
    )
    ended = run("plan", full_table, "--target-latency", 0.01)
    assert ended.code == 2 and "no plan takes 0.01 ms" in ended.err.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("timing", "engine", "precision"),
    [
        ({}, "OnnxEngine", "int8"),
        ({"precision": "fp32"}, "OnnxEngine", "fp32"),
        ({"engine": "openvino", "threads": 1}, "OpenVinoEngine", "int8"),
    ],
)
def test_a_plan_times_the_graphs_that_would_be_shipped(
    monkeypatch: pytest.MonkeyPatch, timing: dict[str, Any], engine: str, precision: str
) -> None:
    from psiamfcpp.recipes import plan
    from psiamfcpp.runtime import graph_file, open_engine
    from psiamfcpp.spec import ModelSpec

    if timing.get("engine") == "openvino":
        pytest.importorskip("openvino")
    opened: list[tuple[str, str]] = []

    def remember(model: str, *options: Any) -> Any:
        found = open_engine(model, *options)
        assert options[1] == timing.get("threads")
        opened.append((type(found).__name__, graph_file.precision(Path(model))))
        assert found.spec.widths == spec.widths and found.spec.search_size == 191
        return found

    monkeypatch.setattr(plan, "open_engine", remember)
    spec = ModelSpec(widths=dict.fromkeys(ARCHITECTURE.groups, 4), search_size=191)
    assert 0 < plan.milliseconds(spec, plan.Timing(**timing)) < 60_000
    assert opened == [(engine, precision)]


@pytest.mark.slow
def test_plans_by_every_criterion(
    run: Run, tiny_model: Path, clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ranks = tmp_path / "ranks.json"
    data = ("--data", f"folder:{clips}", "--held-out-every", 0)
    assert run("rank", tiny_model, *data, "-o", ranks, "--images", 4).code == 0
    (tmp_path / "mine.py").write_text("def last(group, context):\n    return list(range(group.width))\n")
    given = {"rank": ("--ranks", ranks), "norm": (), "median": (), "random": (), "mine:last": (), "taylor": data}
    given["refit"] = (*data, "--images", 4)
    plans: dict[str, dict[str, list[int]]] = {}
    for criterion, options in given.items():
        output = tmp_path / f"{criterion}.json"
        ended = run("plan", tiny_model, "--criterion", criterion, *options, "--remove", 0.5, "--flat", "-o", output)
        assert ended.code == 0, ended.err
        assert f"highest {criterion} removed" in ended.out
        plans[criterion] = json.loads(output.read_text())["keep"]
    assert plans["mine:last"] == {name: [4, 5, 6, 7] for name in ARCHITECTURE.groups}
    assert len({json.dumps(keep) for keep in plans.values()}) == len(plans)
    # With the model or without it, the table's ranks give the same plan.
    bare = tmp_path / "bare.json"
    assert run("plan", ranks, "--remove", 0.5, "--flat", "-o", bare).code == 0
    assert json.loads(bare.read_text())["keep"] == plans["rank"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--criterion", "size"], "unknown criterion 'size': known are rank, norm"),
        (["--criterion", "rank"], "needs the rank table"),
        (["--criterion", "taylor"], "needs gradients"),
        (["--criterion", "refit"], "looks at maps: give --data"),
        (["--criterion", "absent:f"], "'absent:f' cannot be imported"),
    ],
)
def test_criteria_that_lack_something_are_refused(run: Run, tiny_model: Path, options: list[str], message: str) -> None:
    assert message in run("plan", tiny_model, *options, "--remove", "0.5").refused()


def test_a_rank_table_alone_serves_no_other_criterion(run: Run, tiny_model: Path, full_table: Path) -> None:
    assert "give the model" in run("plan", full_table, "--criterion", "norm", "--remove", "0.5").refused()
    args = ("plan", tiny_model, "--ranks", full_table, "--remove", "0.5")
    assert "is not of this model, whose widths differ" in run(*args).refused()


@pytest.mark.slow
def test_clips_held_out_of_training_are_not_ranked(run: Run, tiny_model: Path, clips: Path, tmp_path: Path) -> None:
    args = ("rank", tiny_model, "--data", f"folder:{clips}", "-o", tmp_path / "ranks.json", "--images", 2)
    assert "nothing is left of the data" in run(*args, "--held-out-every", 1).refused()
    assert run(*args).code == 0
    assert json.loads((tmp_path / "ranks.json").read_text())["held_out_every"] == 10
    # Another draw, so its ranks are not those to go on from.
    assert "remove it" in run(*args, "--held-out-every", 0).refused()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "give exactly one"),
        (["--preset", "paper", "--remove", "0.5"], "give exactly one"),
        (["--keep", "backbone.conv1"], "is not GROUP=SHARE"),
        (["--keep", "backbone.conv1=x"], "is not GROUP=SHARE"),
        (["--threshold", "=1"], "no group ''"),
        (["--keep", "backbone.conv1=1.01"], "must lie above 0"),
        (["--keep", "backbone.conv1=0"], "must lie above 0"),
        (["--keep", "backbone.conv1=0.5", "backbone.conv1=0.6"], "twice"),
        (["--keep", "backbone.conv6=0.5"], "no group 'backbone.conv6'"),
        (["--threshold", "backbone.conv1=96"], "lower the threshold"),
        (["--threshold", "backbone.conv1=nan"], "lower the threshold"),
        (["--remove", "1"], "share to remove is 1"),
        (["--remove", "0"], "share to remove is 0"),
        (["--target-macs", "0"], "share of multiply-accumulates is 0"),
        (["--target-macs", "0.001"], "cannot be met"),
        (["--preset", "papr"], "preset"),
        (["--preset", "paper", "--search-size", "300"], "search size 300"),
    ],
)
def test_refused_plans(run: Run, full_table: Path, options: list[str], message: str) -> None:
    before = set(full_table.parent.iterdir())
    assert message in run("plan", full_table, *options, "-o", full_table.parent / "plan.json").refused()
    assert set(full_table.parent.iterdir()) == before


def test_tables_of_other_groups_are_refused(run: Run, full_table: Path) -> None:
    data = json.loads(full_table.read_text())
    data["groups"]["head.cls4"] = data["groups"].pop("head.cls3")
    full_table.write_text(json.dumps(data))
    message = run("plan", full_table, "--preset", "paper").refused()
    assert "lacks head.cls3" in message and "unknown head.cls4" in message


@pytest.mark.slow
def test_plans_that_do_not_fit_are_refused(run: Run, tiny_model: Path, tmp_path: Path) -> None:
    whole = {name: list(range(8)) for name in ARCHITECTURE.groups}
    path, output = tmp_path / "plan.json", tmp_path / "pruned.safetensors"
    for change, message in (
        ({"head.cls1": [0, 0]}, "twice"),
        ({"head.cls1": [8]}, "filter 8 of head.cls1, which has 8"),
        ({"head.cls1": []}, "to zero"),
        ({"head.cls9": [0]}, "unknown head.cls9"),
    ):
        path.write_text(json.dumps({"format": "psiamfcpp-plan/1", "keep": {**whole, **change}}))
        assert message in run("prune", tiny_model, "--plan", path, "-o", output).refused()
    path.write_text(json.dumps({"format": "psiamfcpp-plan/1", "keep": {"head.cls1": [0]}}))
    assert "lacks backbone.conv1" in run("prune", tiny_model, "--plan", path, "-o", output).refused()
    assert list(tmp_path.iterdir()) == [path]
    path.write_text(json.dumps({"format": "psiamfcpp-plan/1", "keep": whole}))
    assert run("prune", tiny_model, "--plan", path, "-o", output).code == 0
    for key, value in load(tiny_model).state_dict().items():
        assert np.array_equal(value, load(output).state_dict()[key])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--images", "1"], "at least 2"),
        (["--batch", "0"], "at least 1"),
        (["-o", "absent/ranks.json"], "folder that exists"),
        (["-o", "ranks.npz"], "must be a .json"),
        (["--data", "nowhere"], "LAYOUT:FOLDER"),
    ],
)
def test_refused_rankings(
    run: Run, tiny_model: Path, clips: Path, tmp_path: Path, options: list[str], message: str
) -> None:
    args = {"--data": f"folder:{clips}", "-o": str(tmp_path / "ranks.json")}
    args.update({options[0]: options[1]})
    assert message in run("rank", tiny_model, *(part for item in args.items() for part in item)).refused()


@pytest.mark.slow
def test_tables_of_another_architecture_are_planned(run: Run, tmp_path: Path) -> None:
    groups = architecture("lightfc").groups
    # Filter i is worth i, and the stem's filters far more.
    table = {n: {"rank": [float(i + 1 + 1e6 * n.endswith("stem")) for i in range(w)]} for n, w in groups.items()}
    ranks, plan = tmp_path / "ranks.json", tmp_path / "plan.json"
    about = {"architecture": "lightfc", "search_size": 256}
    ranks.write_text(json.dumps({"format": "psiamfcpp-ranks/1", "images": 9, **about, "groups": table}))
    ended = run("plan", ranks, "--target-macs", 0.5, "--multiple", 16, "-o", plan, "--flat", "--json")
    assert ended.code == 0, ended.err
    facts = json.loads(ended.out)
    assert facts["before"]["gmacs"] == pytest.approx(0.9187, abs=1e-4) and facts["after"]["gmacs"] <= 0.9187 / 2
    keep = json.loads(plan.read_text())["keep"]
    assert {len(filters) % 16 for filters in keep.values()} == {0}
    assert keep["head.score1"][0] > 0 and keep["head.score1"][-1] == 255
    assert "multiple is 0" in run("plan", ranks, "--target-macs", 0.5, "--multiple", 0).refused()
