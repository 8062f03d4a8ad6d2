"""`psiamfcpp export`: what it writes, says and refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from psiamfcpp.export.parity import Difference

from .conftest import Run

pytest.importorskip("onnx")


@pytest.mark.parametrize("own_data", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_both_graphs_are_written_and_the_difference_is_said(
    run: Run, tiny_model: Path, tmp_path: Path, blob_sequence, own_data: bool
) -> None:
    folder = tmp_path / "new" / "graphs"
    data = ("--data", f"folder:{blob_sequence('beta', [(100, 80, 40, 30), (110, 80, 40, 30)])}")
    ended = run("export", tiny_model, "-o", folder, "--pairs", "4", *(data if own_data else ()))
    assert ended.code == 0
    assert sorted(path.name for path in folder.iterdir()) == ["search.onnx", "template.onnx"]
    assert "against torch: scores differ by up to" in ended.out
    assert list(folder.parent.iterdir()) == [folder]
    assert run("export", tiny_model, "-o", folder, "--pairs", "4", *data, "--overwrite").code == 0


@pytest.mark.slow
def test_int8_is_judged_by_layer_on_given_data(
    run: Run, tiny_model: Path, tmp_path: Path, blob_sequence, monkeypatch
) -> None:
    # the scores of random weights are so alike that 8 bits change which one is highest
    monkeypatch.setattr("psiamfcpp.export.parity._OVERLAP", 0.0)
    data = blob_sequence("beta", [(100, 80, 40, 30), (110, 80, 40, 30)])
    folder = tmp_path / "graphs"
    args = ("export", tiny_model, "-o", folder, "--pairs", "4", "--int8", "--data", f"folder:{data}")
    ended = run(*args, "--layer-loss", "1", "--json")
    assert ended.code == 0, ended.err
    told = json.loads(ended.out)
    assert set(told) == {"output", "scores", "boxes", "overlap", "by_layer", "float_layers"}
    assert len(told["by_layer"]) == 14
    assert told["float_layers"] == []
    assert ended.err.count("in 8 bits alone") == 14


@pytest.mark.slow
def test_what_the_graphs_cost_on_sequences_is_said(run: Run, tiny_model: Path, tmp_path: Path, blob_sequence) -> None:
    root = blob_sequence("beta", [(100, 80, 40, 30), (110, 80, 40, 30), (120, 80, 40, 30)])
    args = ("export", tiny_model, "-o", tmp_path / "graphs", "--data", f"folder:{root}", "--pairs", "4", "--root", root)
    told = json.loads(run(*args, "--json").out)["followed"]
    assert told["graphs"] == pytest.approx(told["torch"])  # float graphs give the same boxes
    assert 1 / 3 < told["torch"]["precision"] <= 1 and 0 < told["torch"]["auc"] <= 1
    assert f"graphs precision {told['graphs']['precision']:.3f}, AUC" in run(*args, "--overwrite").out


def test_a_failed_check_writes_nothing(run: Run, tiny_model: Path, tmp_path: Path, blob_sequence, monkeypatch) -> None:
    data = blob_sequence("beta", [(100, 80, 40, 30), (110, 80, 40, 30)])
    monkeypatch.setattr("psiamfcpp.export.files.compare", lambda *_: Difference(0.5, 0.0, 1.0))
    args = ("export", tiny_model, "-o", tmp_path / "graphs", "--pairs", "4", "--data", f"folder:{data}")
    said = run(*args).refused()
    assert said.startswith("the graphs are not the network: scores differ by up to 0.5 and boxes by up to 0 pixels (")
    assert said.endswith("; nothing was written")
    assert list(tmp_path.iterdir()) == [data]


@pytest.mark.parametrize(
    ("difference", "int8", "message"),
    [
        (Difference(0.002, 0.0, 1.0), False, "scores differ"),
        (Difference(0.0, 0.06, 1.0), False, "boxes by up to 0.06"),
        (Difference(float("nan"), 0.0, 1.0), False, "scores differ"),
        (Difference(0.2, 3.0, 0.89), True, "8 bits change the boxes"),
        (Difference(0.2, 3.0, float("nan")), True, "8 bits"),
    ],
)
def test_what_is_too_far_from_the_network(difference: Difference, int8: bool, message: str) -> None:
    from psiamfcpp import UserError

    with pytest.raises(UserError, match=message):
        difference.check(int8)


def test_what_is_near_enough() -> None:
    Difference(1e-4, 0.01, 0.5).check(int8=False)
    Difference(0.2, 3.0, 0.95).check(int8=True)


@pytest.mark.slow
def test_clips_held_out_of_training_are_not_calibrated_on(
    run: Run, tiny_model: Path, tmp_path: Path, blob_sequence
) -> None:
    data = blob_sequence("beta", [(100, 80, 40, 30), (110, 80, 40, 30)])
    args = ("export", tiny_model, "-o", tmp_path / "graphs", "--pairs", "4", "--data", f"folder:{data}")
    assert "--held-out-every 1 holds out beta: give more clips" in run(*args, "--held-out-every", 1).refused()
    assert run(*args, "--held-out-every", 0).code == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--pairs", "0"), "pairs is 0"),
        (("--data", "stills"), "data 'stills' is not LAYOUT:FOLDER"),
        (("--format", "tflite"), "format"),
    ],
)
def test_wrong_options_are_refused(run: Run, tiny_model: Path, tmp_path: Path, options: tuple, message: str) -> None:
    assert message in run("export", tiny_model, "-o", tmp_path / "graphs", *options).refused()
