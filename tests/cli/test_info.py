"""`psiamfcpp info` and `psiamfcpp import`."""

from __future__ import annotations

import dataclasses
import json
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from psiamfcpp.models import load, save
from psiamfcpp.models.official import _RENAMES
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE

from .conftest import Run

KEYS = {"architecture", "parameters", "gmacs", "widths", "search_size", "constants", "calibration", "provenance"}


def test_info_describes_a_narrow_model(run: Run, tiny_model: Path) -> None:
    ended = run("info", tiny_model, "--json")
    assert (ended.code, ended.err) == (0, "")
    facts = json.loads(ended.out)
    assert facts.keys() == KEYS
    # 8 channels everywhere. A convolution has weights and biases, its BatchNorm a scale and a shift for each channel.
    backbone = (3 * 8 * 121 + 8) + (8 * 8 * 25 + 8) + 3 * (8 * 8 * 9 + 8) + 5 * 16
    neck = 4 * (8 * 8 * 9 + 8 + 16)
    head = 2 * (3 * (8 * 8 * 9 + 8) + 16) + 2 * (8 + 1 + 2) + (8 * 4 + 4 + 8) + 2
    assert facts["parameters"] == backbone + neck + head
    assert facts["widths"] == dict.fromkeys(ARCHITECTURE.groups, 8)
    assert facts["search_size"] == 303
    assert facts["calibration"]["lost_below"] == 0.2
    assert facts["constants"]["test_lr"] == 0.5249642198880932


@pytest.mark.slow
def test_info_of_the_unpruned_network_gives_the_figures_of_the_paper(run: Run, full_model: Path) -> None:
    facts = json.loads(run("info", full_model, "--json").out)
    assert facts["parameters"] == 9_655_380
    assert facts["gmacs"] == pytest.approx(8.56, abs=0.005)
    text = run("info", full_model).out
    assert "9,655,380" in text
    assert "8.56 GMAC at 303 pixels" in text
    assert "backbone.conv2 256" in text


@pytest.mark.parametrize("command", [("info",), ("track", "x.mp4", "--box", "1,2,3,4", "--model")])
def test_models_that_are_none_are_refused(run: Run, tmp_path: Path, command: tuple[str, ...], clip: Path) -> None:
    args = [str(clip) if part == "x.mp4" else part for part in command]
    empty, foreign, half = (tmp_path / f"{name}.safetensors" for name in ("empty", "foreign", "half"))
    empty.touch()
    save_file({"weight": torch.zeros(3)}, str(foreign))
    half.write_bytes(foreign.read_bytes()[:20])
    for path, message in (
        (empty, "cannot be read"),
        (foreign, "does not describe a psiamfcpp model"),
        (half, "cannot be read"),
        (clip, "cannot be read"),
        (tmp_path, "neither a file nor a shipped model"),
        (tmp_path / "none.safetensors", "neither a file nor a shipped model"),
    ):
        complaint = run(*args, path).refused()
        assert str(path) in complaint
        assert message in complaint


def test_what_a_model_says_of_itself_moves_no_cursor(run: Run, tiny_model: Path, tmp_path: Path) -> None:
    network = load(tiny_model)
    network.spec = dataclasses.replace(network.spec, provenance={"note": "\x1b[2J\x07 \ud800 M\u00fcller"})
    save(tmp_path / "model.safetensors", network)
    ended = run("info", tmp_path / "model.safetensors")
    assert "note \\x1b[2J\\x07 \\ud800 M\u00fcller" in ended.out
    assert "\x1b[2J\\n" not in run("info", tmp_path / "\x1b[2J").refused()


@pytest.mark.parametrize(
    ("provenance", "lines"),
    [
        ({}, ["none"]),
        ({"calibration": {"clips": 9, "hit": 0.123456}}, ["calibration clips 9, hit 0.1235"]),
        (
            {
                "training": [
                    {"init": "a", "options": {"batch": 8, "clip": 10.0}},
                    {"teacher": {"teacher": ""}, "data": ["b", "c"]},
                ]
            },
            ["training 1: init a, batch 8", "training 2: data b c"],
        ),
        ({"pruning": ["by hand", {"unknown": [1, 0.00001]}]}, ["pruning 1: by hand", "pruning 2: unknown 1 1e-05"]),
    ],
)
def test_info_gives_each_step_of_the_making_a_short_line(
    run: Run, tiny_model: Path, tmp_path: Path, provenance: dict[str, object], lines: list[str]
) -> None:
    network = load(tiny_model)
    network.spec = dataclasses.replace(network.spec, provenance=provenance)
    save(tmp_path / "model.safetensors", network)
    text = run("info", tmp_path / "model.safetensors").out
    assert text.endswith("provenance   " + ("\n" + " " * 13).join(lines) + "\n")


@pytest.mark.parametrize("command", [("evaluate", "--root"), ("datasets", "--root"), ("report", "-o", "x"), ("plan",)])
def test_a_name_that_is_too_long_is_one_line(run: Run, command: tuple[str, ...]) -> None:
    assert run(*command, "a" * 500).refused()


@pytest.mark.parametrize(
    ("tracker", "facts"),
    [
        ("opencv:mil", {"kind": "opencv", "name": "opencv-mil"}),
        ("TrackerMIL", {"kind": "opencv", "name": "TrackerMIL"}),
        ("trax:tracker --fast", {"kind": "trax", "name": "trax-tracker"}),
    ],
)
def test_info_takes_every_tracker_that_track_takes(run: Run, tracker: str, facts: dict[str, str]) -> None:
    assert facts.items() <= json.loads(run("info", tracker, "--json").out).items()
    text = run("info", tracker).out
    assert all(f"{key:12} {value}\n" in text for key, value in facts.items())


def test_options_of_a_model_do_not_change_its_description(run: Run, tiny_model: Path) -> None:
    assert run("info", f"{tiny_model},plain=true").out == run("info", tiny_model).out
    assert "'plan'" in run("info", f"{tiny_model},plan=true").refused()


# import


class Bomb:
    """Unpickling this would make a file."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


def test_import_refuses_what_is_no_checkpoint_and_runs_nothing(run: Run, tmp_path: Path, tiny_model: Path) -> None:
    folder = tmp_path / "given"
    folder.mkdir()
    (folder / "empty.pkl").touch()
    (folder / "text.pkl").write_text("these are no weights")
    (folder / "bomb.pkl").write_bytes(pickle.dumps({"model_state_dict": Bomb(tmp_path / "boom")}, protocol=2))
    torch.save({"model_state_dict": {"w": Bomb(tmp_path / "boom")}}, folder / "bomb.pth")
    torch.save([1, 2, 3], folder / "list.pth")
    torch.save({"epoch": 3}, folder / "numbers.pth")
    torch.save({"basemodel.conv1.conv.weight": torch.zeros(96, 3, 11, 11)}, folder / "part.pth")
    (folder / "other.pth").write_bytes(tiny_model.read_bytes())
    output = tmp_path / "out.safetensors"
    for path in [*sorted(folder.iterdir()), folder / "none.pth"]:
        assert path.name in run("import", path, "-o", output).refused()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["given"]


@pytest.mark.slow
def test_import_converts_an_official_checkpoint(run: Run, tmp_path: Path, full_model: Path) -> None:
    model = load(full_model)
    official = {}
    for key, value in model.state_dict().items():
        for pattern, ours in _RENAMES:
            theirs = pattern.lstrip("^").replace("\\.", ".").replace(r"(\d)", "#")
            for number in "123":
                key = key.replace(ours.replace(r"\1", number), theirs.replace("#", number))
        official[f"module.{key}"] = value
    assert "module.head.bbox_p5_conv2.conv.weight" in official
    torch.save({"epoch": 19, "model_state_dict": official}, tmp_path / "official.pkl")
    output = tmp_path / "ours.safetensors"
    ended = run("import", tmp_path / "official.pkl", "-o", output)
    assert (ended.code, ended.err) == (0, "")
    assert "9,655,380 parameters" in ended.out
    imported = load(output)
    assert all(torch.equal(v, imported.state_dict()[k]) for k, v in model.state_dict().items())
    assert imported.spec.provenance == {"imported_from": "official.pkl"}
    # and where it cannot be written, nothing is left
    assert "cannot be written" in run("import", tmp_path / "official.pkl", "-o", output / "x.safetensors").refused()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["official.pkl", "ours.safetensors"]


def test_info_of_a_model_without_calibration(run: Run, tmp_path: Path, tiny_model: Path) -> None:
    network = load(tiny_model)
    network.spec = dataclasses.replace(network.spec, calibration=None)
    save(tmp_path / "open.safetensors", network)
    assert "calibration  none\n" in run("info", tmp_path / "open.safetensors").out
    assert json.loads(run("info", tmp_path / "open.safetensors", "--json").out)["calibration"] is None


def test_info_of_graphs_is_that_of_the_network_that_they_were_made_from(
    run: Run, tiny_model: Path, tiny_graphs: Path
) -> None:
    of_graphs, of_network = (json.loads(run("info", path, "--json").out) for path in (tiny_graphs, tiny_model))
    assert of_graphs == of_network
