"""Checkpoints: a safetensors file whose metadata describes the model; nothing in it is ever run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import safetensors.torch
import torch
from safetensors import safe_open
from torch import Tensor

from psiamfcpp.errors import UserError, brief
from psiamfcpp.files import check_file, write_whole
from psiamfcpp.models.arch import opened
from psiamfcpp.models.network import Network
from psiamfcpp.spec import ModelSpec
from psiamfcpp.zoo import weights_path

# The number of tensors that are named where they do not fit.
_NAMED = 30


def load(path_or_name: str | Path) -> Network:
    """A network from a checkpoint file or from the name of shipped weights, in evaluation mode, float32.

    Raises:
        UserError: no such file or name, not one of our checkpoints, or weights that don't fit the widths it states.
    """
    path = weights_path(path_or_name)
    spec, weights = read(path)
    model = build(spec)
    fit(model, weights, str(path))
    return model.eval()


def build(spec: ModelSpec) -> Network:
    """Return a new network of a spec's architecture and widths, its weights random."""
    network: Network = opened(spec.arch.network)(spec)
    return network


def read(path: Path) -> tuple[ModelSpec, dict[str, Tensor]]:
    """The spec and the tensors of a checkpoint, as stored; the header is compared with the spec before any is read.

    Raises:
        UserError: the file is not a checkpoint of ours, or its tensors are not those that its spec states.
    """
    check_file(path, "checkpoint")
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            if "psiamfcpp" not in metadata:
                raise UserError(f"{path} does not describe a psiamfcpp model: was it made by another program?")
            spec = ModelSpec.from_json(metadata["psiamfcpp"])
            shapes = {key: tuple(file.get_slice(key).get_shape()) for key in file.keys()}  # noqa: SIM118 - not a dict
            with torch.device("meta"):
                _check_shapes(build(spec).state_dict(), shapes, str(path))
            return spec, {key: file.get_tensor(key) for key in shapes}
    except UserError as error:
        raise error if str(path) in str(error) else UserError(f"checkpoint {path}: {error}") from None
    except Exception as error:  # a damaged file can fail in any way
        raise UserError(
            f"checkpoint {path} cannot be read ({brief(error)}): the file is damaged or no safetensors"
        ) from None


def save(path: Path, model: Network, dtype: torch.dtype = torch.float32) -> None:
    """Write a checkpoint, completely or not at all; its folder is made.

    Args:
        path: where to, normally ``*.safetensors``.
        model: the network; its ``spec`` goes into the metadata.
        dtype: floating-point type of the stored tensors; one with values beyond its range stays as it is.

    Raises:
        UserError: the file cannot be written.
    """
    tensors = {key: _as_stored(value.detach().cpu(), dtype).contiguous() for key, value in model.state_dict().items()}
    write_whole(path, safetensors.torch.save(tensors, {"psiamfcpp": model.spec.to_json()}))


def fit(model: Network, weights: dict[str, Tensor], origin: str) -> None:
    """Copy weights into the model; every name and every shape must match.

    BatchNorm's ``num_batches_tracked`` counts training steps, is no weight, and may be absent.

    Raises:
        UserError: lists the names that are missing, extra or of another shape.
    """
    own = model.state_dict()
    _check_shapes(own, {name: tuple(value.shape) for name, value in weights.items()}, origin)
    plain = (k for k, v in weights.items() if v.layout == torch.strided and v.device.type == "cpu")
    alike = {k for k in plain if weights[k].is_floating_point() == own[k].is_floating_point()}
    if odd := sorted(weights.keys() - alike):
        raise UserError(f"{origin} holds no plain numbers in {_listed(odd)}: the file is damaged")
    bad = sorted(k for k, v in weights.items() if not torch.isfinite(v.float()).all())
    if bad:
        raise UserError(f"{origin} holds values that are not finite in {_listed(bad)}: the file is damaged")
    model.load_state_dict({**own, **{k: v.to(own[k].dtype) for k, v in weights.items()}})


def _check_shapes(own: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]], origin: str) -> None:
    """Raise unless the shapes of a file's tensors are those of a network's; see `fit`."""
    missing = [k for k in own if k not in shapes and not k.endswith("num_batches_tracked")]
    extra = [k for k in shapes if k not in own]
    wrong = [
        f"{k} {shapes[k]} instead of {tuple(own[k].shape)}" for k in own if k in shapes and shapes[k] != own[k].shape
    ]
    faults = [
        f"{what} {_listed(sorted(names))}"
        for what, names in (("missing:", missing), ("extra:", extra), ("of another shape:", wrong))
        if names
    ]
    if faults:
        raise UserError(f"{origin} does not fit the network; {'; '.join(faults)}")


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(name[:100] for name in names[:_NAMED]) + more


def _as_stored(value: Tensor, dtype: torch.dtype) -> Tensor:
    """The tensor in a type to store, unless its values would overflow: BatchNorm's variances exceed float16's 65504."""
    if not value.is_floating_point():
        return value
    cast = value.to(dtype)
    return cast if torch.isfinite(cast).all() else value
