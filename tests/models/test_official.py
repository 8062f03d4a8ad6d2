from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from psiamfcpp.errors import UserError
from psiamfcpp.models import SiamFCpp
from psiamfcpp.models.official import import_official

OFFICIAL = {
    **{f"backbone.conv{i}": f"basemodel.conv{i}" for i in range(1, 6)},
    "neck.cls_template": "c_z_k",
    "neck.cls_search": "c_x",
    "neck.reg_template": "r_z_k",
    "neck.reg_search": "r_x",
    **{f"head.cls{i}": f"head.cls_p5_conv{i}" for i in range(1, 4)},
    **{f"head.reg{i}": f"head.bbox_p5_conv{i}" for i in range(1, 4)},
    "head.cls_score": "head.cls_score_p5",
    "head.centerness": "head.ctr_score_p5",
    "head.reg_offsets": "head.bbox_offsets_p5",
}


def official_name(name: str) -> str:
    block, _, rest = name.rpartition(".conv.") if ".conv." in name else name.rpartition(".bn.")
    return f"{OFFICIAL[block]}.{'conv' if '.conv.' in name else 'bn'}.{rest}" if block else name


@pytest.fixture
def state(full_network: SiamFCpp) -> dict[str, Tensor]:
    """The full network under the official names."""
    return {official_name(name): value for name, value in full_network.state_dict().items()}


@pytest.fixture
def write(tmp_path: Path) -> Callable[[Any], Path]:
    def to_file(content: Any) -> Path:
        torch.save(content, tmp_path / "official.pkl")
        return tmp_path / "official.pkl"

    return to_file


def test_the_state_has_the_official_names(state: dict[str, Tensor]):
    assert {"basemodel.conv1.conv.weight", "c_z_k.bn.running_mean", "r_x.conv.bias", "head.si"} <= set(state)
    assert {"head.cls_p5_conv1.conv.weight", "head.bbox_offsets_p5.bn.weight"} <= set(state)


@pytest.mark.slow
@pytest.mark.parametrize(
    "variant",
    [
        lambda state: state,
        lambda state: {"model_state_dict": state, "epoch": 19},
        lambda state: {f"module.{name}": value for name, value in state.items()},
        lambda state: {"model_state_dict": {f"module.{name}": value for name, value in state.items()}},
        lambda state: {**state, "head.si": state["head.si"].reshape(1), "head.bi": state["head.bi"].reshape(1)},
        lambda state: {name: value for name, value in state.items() if "num_batches" not in name},
    ],
    ids=["bare", "nested", "prefixed", "nested and prefixed", "scalars as vectors", "without counts"],
)
@torch.no_grad()
def test_outputs_are_those_of_the_original(full_network: SiamFCpp, state, write, crops, variant):
    network = import_official(write(variant(state)))
    z, x = crops(1, 127, 1), crops(1, 191, 2)
    for ours, original in zip(network(z, x), full_network(z, x), strict=True):
        torch.testing.assert_close(ours, original, rtol=1e-5, atol=1e-5)
    assert not network.training
    assert network.spec.provenance["imported_from"] == "official.pkl"


def test_the_old_torch_format_is_read(state, tmp_path: Path):
    path = tmp_path / "old.pth"
    torch.save(state, path, _use_new_zipfile_serialization=False)
    assert torch.equal(import_official(path).head.si, state["head.si"])


def test_an_import_does_not_mark_other_networks(state, write):
    import_official(write(state))
    assert SiamFCpp().spec.provenance == {}


def test_misfits_are_named_by_our_names(state, write):
    del state["basemodel.conv3.conv.weight"]
    state["head.density.weight"] = torch.zeros(1)
    state["c_x.conv.bias"] = torch.zeros(255)
    with pytest.raises(UserError) as caught:
        import_official(write(state))
    message = str(caught.value)
    assert "official.pkl does not fit the network" in message
    assert "missing: backbone.conv3.conv.weight" in message
    assert "extra: head.density.weight" in message
    assert "neck.cls_search.conv.bias (255,) instead of (256,)" in message


@pytest.mark.parametrize(
    "content",
    [{}, [], 5, {"model_state_dict": {}}, {"weight": "text"}, {0: torch.zeros(1)}, {"model_state_dict": 3}],
    ids=str,
)
def test_other_content_is_refused(write, content: Any):
    with pytest.raises(UserError, match=r"official\.pkl holds no state dict"):
        import_official(write(content))


class _Trap:
    """Would make a file when unpickled."""

    def __init__(self, target: Path):
        self._target = target

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self._target,)


@pytest.mark.parametrize("wrap", [lambda trap: trap, lambda trap: {"head.si": trap, "model_state_dict": {}}])
@pytest.mark.parametrize("zipped", [True, False])
def test_code_in_a_pickle_is_refused_and_never_runs(tmp_path: Path, wrap, zipped: bool):
    path, target = tmp_path / "trap.pkl", tmp_path / "touched"
    torch.save(wrap(_Trap(target)), path, _use_new_zipfile_serialization=zipped)
    with pytest.raises(UserError, match=r"trap\.pkl cannot be read as plain weights"):
        import_official(path)
    assert not target.exists()
    torch.load(path, weights_only=False)
    assert target.exists(), "the trap itself must work"


@pytest.mark.parametrize("data", [b"", b"junk", b"\x80\x02}", b"PK\x03\x04", bytes(range(256)), b"(lp0\n."])
def test_junk(tmp_path: Path, data: bytes):
    path = tmp_path / "junk.pkl"
    path.write_bytes(data)
    with pytest.raises(UserError, match=r"junk\.pkl (cannot be read as plain weights|holds no state dict)") as caught:
        import_official(path)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("zipped", [True, False])
def test_damaged_files_are_refused_whatever_the_damage(tmp_path: Path, zipped: bool):
    path = tmp_path / "damaged.pkl"
    torch.save({"a": torch.zeros(3), "b": torch.ones(2)}, path, _use_new_zipfile_serialization=zipped)
    whole = path.read_bytes()
    for position in range(0, len(whole), 1 + len(whole) // 60):
        for data in (whole[:position], whole[:position] + b"\x7f" + whole[position + 1 :]):
            path.write_bytes(data)
            with pytest.raises(UserError, match=r"damaged\.pkl"):
                import_official(path)


def test_no_such_file(tmp_path: Path):
    with pytest.raises(UserError, match=r"gone\.pkl does not exist"):
        import_official(tmp_path / "gone.pkl")
    with pytest.raises(UserError, match="is not a file"):
        import_official(tmp_path)
