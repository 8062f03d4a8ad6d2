from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor

from psiamfcpp.errors import UserError
from psiamfcpp.models import SiamFCpp, save
from psiamfcpp.models.alexnet import init_backbone, is_alexnet
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.spec import ModelSpec

SHAPES = {
    0: (64, 3, 11, 11),
    3: (192, 64, 5, 5),
    6: (384, 192, 3, 3),
    8: (256, 384, 3, 3),
    10: (256, 256, 3, 3),
}


@pytest.fixture(scope="module")
def weights() -> dict[str, Tensor]:
    """Random tensors under torchvision's names, with its widths."""
    generator = torch.Generator().manual_seed(0)
    tensors = {}
    for index, shape in SHAPES.items():
        spread = (2 / (shape[1] * shape[2] * shape[3])) ** 0.5
        tensors[f"features.{index}.weight"] = torch.randn(shape, generator=generator) * spread
        tensors[f"features.{index}.bias"] = torch.randn(shape[0], generator=generator) * 0.1
    return tensors


@pytest.fixture
def write(tmp_path: Path, weights: dict[str, Tensor]) -> Callable[..., Path]:
    """Writes the file, with changes; None takes a tensor away."""

    def to_file(changes: dict[str, Tensor | None] | None = None) -> Path:
        tensors = {k: v for k, v in {**weights, **(changes or {})}.items() if v is not None}
        save_file(tensors, str(tmp_path / "alexnet.safetensors"))
        return tmp_path / "alexnet.safetensors"

    return to_file


def normalised_rgb(bgr: Tensor) -> Tensor:
    mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    return (bgr.flip(1) / 255 - mean[None, :, None, None]) / deviation[None, :, None, None]


@pytest.mark.slow
@torch.no_grad()
def test_conv1_takes_bgr_levels(write, weights, crops):
    network = SiamFCpp()
    init_backbone(network, write())
    image = crops(2, 31)
    expected = F.conv2d(normalised_rgb(image), weights["features.0.weight"], weights["features.0.bias"], stride=2)
    torch.testing.assert_close(network.backbone.conv1.conv(image)[:, :64], expected, rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_widening_without_noise_keeps_the_function(write, weights, crops, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("psiamfcpp.models.alexnet._COPY_NOISE", 0.0)
    network = SiamFCpp().eval()
    init_backbone(network, write())
    image = crops(1, 127)
    x = normalised_rgb(image)
    for index in SHAPES:
        x = F.conv2d(x, weights[f"features.{index}.weight"], weights[f"features.{index}.bias"], 2 if index == 0 else 1)
        x = F.relu(x) if index < 10 else x
        x = F.max_pool2d(x, 3, 2, ceil_mode=True) if index in (0, 3) else x
    assert x.shape == (1, 256, 6, 6)
    # BatchNorm as the identity divides by sqrt(1 + 1e-5) in each layer.
    assert (network.backbone(image) - x).norm() < 1e-3 * x.norm()


@pytest.mark.slow
@torch.no_grad()
def test_widening_with_noise_nearly_keeps_it(write, crops, monkeypatch: pytest.MonkeyPatch):
    noisy, exact = SiamFCpp().eval(), SiamFCpp().eval()
    init_backbone(noisy, write())
    monkeypatch.setattr("psiamfcpp.models.alexnet._COPY_NOISE", 0.0)
    init_backbone(exact, write())
    image = crops(1, 127)
    difference = (noisy.backbone(image) - exact.backbone(image)).norm() / exact.backbone(image).norm()
    assert 1e-3 < difference < 0.3


@pytest.mark.parametrize(("layer", "published"), [("conv1", 64), ("conv2", 192), ("conv4", 256)])
def test_copies_resemble_one_original_but_equal_none(write, layer: str, published: int):
    network = SiamFCpp()
    init_backbone(network, write())
    filters = getattr(network.backbone, layer).conv.weight.detach().flatten(1)
    originals, copies = filters[:published], filters[published:]
    assert len(copies) == ARCHITECTURE.groups[f"backbone.{layer}"] - published
    alike = F.normalize(copies) @ F.normalize(originals).T
    assert (alike.amax(dim=1) > 0.98).all()
    assert len(set(alike.argmax(dim=1).tolist())) == len(copies)
    assert alike.max() < 0.9999


def test_original_and_copy_are_read_unevenly(write, weights, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("psiamfcpp.models.alexnet._COPY_NOISE", 0.0)
    network = SiamFCpp()
    init_backbone(network, write())
    readers = network.backbone.conv2.conv.weight.detach()[:192]
    published = weights["features.3.weight"]
    shares = (readers[:, :64] * published).sum(dim=(0, 2, 3)) / (published**2).sum(dim=(0, 2, 3))
    split = shares[shares < 0.99]
    assert len(split) == 96 - 64
    assert ((split > 0.29) & (split < 0.71)).all()
    assert split.std() > 0.05


@pytest.mark.parametrize(("seed", "equal"), [(7, True), (8, False)])
def test_the_seed_decides(write, seed: int, equal: bool):
    one, other = SiamFCpp(), SiamFCpp()
    init_backbone(one, write(), seed=7)
    init_backbone(other, write(), seed=seed)
    assert torch.equal(one.backbone.conv1.conv.weight, other.backbone.conv1.conv.weight) is equal


@pytest.mark.parametrize("name", ["features.0.weight", "features.8.bias"])
def test_missing_tensor(write, name: str):
    with pytest.raises(UserError, match=rf"alexnet\.safetensors lack '{name}'"):
        init_backbone(SiamFCpp(), write({name: None}))


@pytest.mark.parametrize(
    ("layer", "name", "shape"),
    [
        ("conv1", "features.0.weight", (63, 3, 11, 11)),
        ("conv1", "features.0.weight", (64, 3, 7, 7)),
        ("conv1", "features.0.weight", (64, 1, 11, 11)),
        ("conv2", "features.3.weight", (192, 63, 5, 5)),
        ("conv3", "features.6.bias", (383,)),
        ("conv5", "features.10.weight", (256,)),
    ],
)
def test_other_shapes_name_the_layer(write, layer: str, name: str, shape: tuple[int, ...]):
    with pytest.raises(UserError, match=rf"^{layer} of .*alexnet\.safetensors is \("):
        init_backbone(SiamFCpp(), write({name: torch.zeros(shape)}))


@pytest.mark.parametrize(
    ("width", "complaint"), [(63, "at most 63 filters"), (129, "cannot widen 64 filters to 129: at most twice")]
)
def test_networks_too_narrow_or_too_wide(write, width: int, complaint: str):
    network = SiamFCpp(ModelSpec(widths={**ARCHITECTURE.groups, "backbone.conv1": width}))
    with pytest.raises(UserError, match=complaint):
        init_backbone(network, write())


def test_is_alexnet_knows_one_from_ours(write, make_network, tmp_path: Path):
    save(tmp_path / "ours.safetensors", make_network())
    assert is_alexnet(write())
    assert not is_alexnet(tmp_path / "ours.safetensors")


@pytest.mark.parametrize("function", [is_alexnet, lambda path: init_backbone(SiamFCpp(), path)])
@pytest.mark.parametrize("data", [None, b"", b"junk"])
def test_unreadable_files(tmp_path: Path, function, data: bytes | None):
    path = tmp_path / "a.safetensors"
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(UserError, match=r"a\.safetensors (cannot be read|does not exist)"):
        function(path)
