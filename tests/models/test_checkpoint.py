from __future__ import annotations

import dataclasses
import json
import os
import stat
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from psiamfcpp.errors import UserError
from psiamfcpp.models import load, save
from psiamfcpp.models.checkpoint import fit, read
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.spec import Calibration, TrackingConstants


@pytest.fixture
def checkpoint(make_network, tmp_path: Path) -> Path:
    path = tmp_path / "model.safetensors"
    save(path, make_network())
    return path


def rewrite(path: Path, changes: dict[str, torch.Tensor | None], metadata: dict[str, str] | None = None) -> None:
    """Change a checkpoint's tensors; None takes one away."""
    spec, tensors = read(path)
    tensors = {k: v for k, v in {**tensors, **changes}.items() if v is not None}
    save_file(tensors, str(path), metadata={"psiamfcpp": spec.to_json()} if metadata is None else metadata)


def test_round_trip_keeps_every_bit(make_network, checkpoint: Path):
    saved, loaded = make_network().state_dict(), load(checkpoint).state_dict()
    assert saved.keys() == loaded.keys()
    for name in saved:
        assert saved[name].dtype == loaded[name].dtype
        assert torch.equal(saved[name], loaded[name]), name


def test_loaded_networks_are_ready_to_evaluate(checkpoint: Path):
    assert not any(module.training for module in load(str(checkpoint)).modules())


def test_the_spec_survives(make_network, tmp_path: Path):
    network = make_network(search_size=239)
    network.spec = dataclasses.replace(
        network.spec,
        constants=TrackingConstants(test_lr=0.1),
        calibration=Calibration(bias=-1.25, lost_below=0.125),
        provenance={"training": [{"data": ["stills:é"]}]},
    )
    save(tmp_path / "m.safetensors", network)
    assert load(tmp_path / "m.safetensors").spec == network.spec


@pytest.mark.slow
def test_half_precision_is_smaller_and_close(make_network, tmp_path: Path):
    network = make_network()
    half, full = tmp_path / "half.safetensors", tmp_path / "full.safetensors"
    save(half, network, torch.float16)
    save(full, network)
    assert half.stat().st_size < 0.75 * full.stat().st_size
    assert read(half)[1]["neck.cls_search.conv.weight"].dtype == torch.float16
    for name, value in load(half).state_dict().items():
        assert value.dtype == network.state_dict()[name].dtype
        torch.testing.assert_close(value, network.state_dict()[name], rtol=1e-3, atol=1e-6)


def test_half_precision_does_not_overflow(make_network, tmp_path: Path):
    network = make_network()
    network.backbone.conv1.bn.running_var[0] = 1e5
    save(tmp_path / "half.safetensors", network, torch.float16)
    assert load(tmp_path / "half.safetensors").backbone.conv1.bn.running_var[0] == 1e5


def test_channels_last_networks_are_saved_alike(make_network, checkpoint: Path, tmp_path: Path):
    save(tmp_path / "other.safetensors", make_network().to(memory_format=torch.channels_last))
    assert (tmp_path / "other.safetensors").read_bytes() == checkpoint.read_bytes()


def test_saving_replaces_and_leaves_nothing_else(make_network, checkpoint: Path):
    save(checkpoint, make_network(seed=5))
    assert torch.equal(load(checkpoint).head.bi, make_network(seed=5).head.bi)
    assert [p.name for p in checkpoint.parent.iterdir()] == ["model.safetensors"]


def test_all_misfits_are_named_at_once(checkpoint: Path):
    changes = {
        "head.si": None,
        "neck.cls_search.conv.bias": None,
        "head.cls9.conv.weight": torch.zeros(1),
        "backbone.conv1.conv.bias": torch.zeros(99),
    }
    rewrite(checkpoint, changes)
    with pytest.raises(UserError) as caught:
        load(checkpoint)
    message = str(caught.value)
    assert str(checkpoint) in message
    assert "missing: head.si, neck.cls_search.conv.bias" in message
    assert "extra: head.cls9.conv.weight" in message
    assert "of another shape: backbone.conv1.conv.bias (99,) instead of (3,)" in message


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(checkpoint: Path, value: float):
    rewrite(checkpoint, {"head.bi": torch.tensor(value)})
    with pytest.raises(UserError, match=r"not finite in head\.bi"):
        load(checkpoint)


def test_the_count_of_batches_may_be_absent(make_network, checkpoint: Path):
    counts = [name for name in make_network().state_dict() if name.endswith("num_batches_tracked")]
    assert counts
    rewrite(checkpoint, dict.fromkeys(counts))
    assert torch.equal(load(checkpoint).head.si, make_network().head.si)


def test_a_misfit_leaves_the_network_as_it_was(make_network):
    network = make_network()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    weights = {**make_network(seed=9).state_dict(), "head.si": torch.zeros(2)}
    with pytest.raises(UserError):
        fit(network, weights, "here")
    assert all(torch.equal(before[name], value) for name, value in network.state_dict().items())


def _cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def _noisy_header(data: bytes) -> bytes:
    return data[:20] + b"\xff\xfe\xfd" + data[23:]


@pytest.mark.parametrize(
    "damage", [_cut, _noisy_header, lambda _: b"", lambda _: b"junk", lambda d: d[:8], lambda d: b"\xff" * 8 + d[8:]]
)
def test_damaged_files(checkpoint: Path, damage):
    checkpoint.write_bytes(damage(checkpoint.read_bytes()))
    with pytest.raises(UserError, match=r"checkpoint .*model\.safetensors cannot be read"):
        load(checkpoint)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"widths": dict.fromkeys(ARCHITECTURE.groups, 10**4)}, "of another shape: backbone.conv1.bn.bias"),
        (
            {"widths": dict.fromkeys(ARCHITECTURE.groups, 10**6)},
            "width of .* is 1000000: it must be a whole number from 1 to",
        ),
        ({"widths": {**ARCHITECTURE.groups, "neck.cls": 10**30}}, "width of neck.cls is 1000000"),
        ({"widths": {**ARCHITECTURE.groups, "neck.cls": True}}, "width of neck.cls is True"),
        ({"template_size": 95}, "template size is 95: siamfcpp-alexnet has 127"),
        ({"template_size": -1}, "template size is -1"),
        ({"search_size": 8_000_000_303}, "search size 8000000303 is too large"),
        ({"search_size": True}, "search_size in ModelSpec is True"),
        ({"provenance": "mine"}, "provenance in ModelSpec is 'mine'"),
        ({"provenance": {"training": 3}}, "training in the provenance is no list of steps"),
        ({"architecture": []}, r"architecture in ModelSpec is \[\]"),
        ({"architecture": "resnet"}, "unknown architecture 'resnet'"),
    ],
)
def test_a_description_is_compared_with_the_header_before_memory_is_taken(
    checkpoint: Path, changes: dict[str, Any], message: str
):
    spec, weights = read(checkpoint)
    text = json.dumps({**json.loads(spec.to_json()), **changes})
    rewrite(checkpoint, weights, {"psiamfcpp": text})
    with pytest.raises(UserError, match=message) as caught:
        load(checkpoint)
    assert len(str(caught.value)) < 4000


def test_of_many_unknown_tensors_the_first_are_named(checkpoint: Path):
    spec, weights = read(checkpoint)
    more = {f"x{number:05}": torch.zeros(1) for number in range(1000)}
    rewrite(checkpoint, {**weights, **more}, {"psiamfcpp": spec.to_json()})
    with pytest.raises(UserError, match=r"extra: x00000, .* and 970 more$"):
        load(checkpoint)


@pytest.mark.parametrize("dtype", [torch.int32, torch.bool, torch.complex64, torch.uint8])
def test_tensors_of_another_kind_are_named(checkpoint: Path, dtype: torch.dtype):
    spec, weights = read(checkpoint)
    name = "neck.cls_search.conv.weight"
    rewrite(checkpoint, {**weights, name: weights[name].to(dtype)}, {"psiamfcpp": spec.to_json()})
    with pytest.raises(UserError, match=rf"holds no plain numbers in {name}"):
        load(checkpoint)


@pytest.mark.parametrize("metadata", [{}, {"format": "pt"}])
def test_foreign_safetensors(checkpoint: Path, metadata: dict[str, str]):
    rewrite(checkpoint, {}, metadata)
    with pytest.raises(UserError, match=r"model\.safetensors does not describe a psiamfcpp model"):
        load(checkpoint)


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"format": "psiamfcpp-model/9"}'])
def test_damaged_descriptions_name_the_file(checkpoint: Path, text: str):
    rewrite(checkpoint, {}, {"psiamfcpp": text})
    with pytest.raises(UserError, match=r"checkpoint .*model\.safetensors: model description"):
        load(checkpoint)


def test_no_such_file(tmp_path: Path):
    with pytest.raises(UserError, match=r"gone\.safetensors' is neither a file nor a shipped model"):
        load(tmp_path / "gone.safetensors")


def test_a_folder_is_no_checkpoint(tmp_path: Path):
    with pytest.raises(UserError, match="is neither a file nor a shipped model"):
        load(tmp_path)
    with pytest.raises(UserError, match="is not a file"):
        read(tmp_path)


def _below_a_file(root: Path) -> Path:
    (root / "file").write_text("")
    return root / "file" / "m.safetensors"


def _onto_a_folder(root: Path) -> Path:
    (root / "folder").mkdir()
    return root / "folder"


@pytest.mark.parametrize("target", [_below_a_file, _onto_a_folder])
def test_unwritable_targets_leave_nothing_behind(make_network, tmp_path: Path, target):
    path = target(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError, match=f"{path} cannot be written"):
        save(path, make_network())
    assert sorted(tmp_path.rglob("*")) == before


def test_a_target_without_a_name(make_network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="cannot be written"):
        save(Path(), make_network())
    assert list(tmp_path.iterdir()) == []


def test_a_failed_save_keeps_the_old_file(make_network, checkpoint: Path, monkeypatch: pytest.MonkeyPatch):
    before = checkpoint.read_bytes()

    def fail(*_args: object, **_kwargs: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr("psiamfcpp.files.os.fsync", fail)
    with pytest.raises(UserError, match="no space left"):
        save(checkpoint, make_network(seed=3))
    assert checkpoint.read_bytes() == before


@pytest.mark.skipif(os.name != "posix", reason="modes of POSIX")
def test_others_may_read_a_checkpoint_if_the_umask_lets_them(make_network, tmp_path: Path):
    before = os.umask(0o022)
    try:
        save(tmp_path / "m.safetensors", make_network())
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "m.safetensors").stat().st_mode) == 0o644


def test_what_loads_is_the_network(make_network, checkpoint: Path, crops):
    z, x = crops(1, 127), crops(1, 191)
    with torch.no_grad():
        for saved, loaded in zip(make_network()(z, x), load(checkpoint)(z, x), strict=True):
            assert torch.equal(saved, loaded)
