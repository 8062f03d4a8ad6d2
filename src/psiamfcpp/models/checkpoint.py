"""Checkpoints: a safetensors file whose metadata describes the model; nothing in it is ever run."""

from __future__ import annotations

from pathlib import Path

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from psiamfcpp.errors import UserError
from psiamfcpp.files import write_whole
from psiamfcpp.models.arch import opened
from psiamfcpp.models.network import Network
from psiamfcpp.spec import ModelSpec
from psiamfcpp.zoo import weights_path


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
    """The spec and the tensors of a checkpoint, as stored.

    Raises:
        UserError: the file is not a checkpoint of ours.
    """
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            if "psiamfcpp" not in metadata:
                raise UserError(f"{path} does not describe a psiamfcpp model: was it made by another program?")
            return ModelSpec.from_json(metadata["psiamfcpp"]), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
    except (SafetensorError, OSError) as error:
        raise UserError(f"checkpoint {path} cannot be read ({error}): the file is damaged or no safetensors") from None
    except UserError as error:
        raise error if str(path) in str(error) else UserError(f"checkpoint {path}: {error}") from None


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
    missing = sorted(k for k in own if k not in weights and not k.endswith("num_batches_tracked"))
    extra = sorted(k for k in weights if k not in own)
    shapes = sorted(
        f"{k} {tuple(weights[k].shape)} instead of {tuple(own[k].shape)}"
        for k in own
        if k in weights and weights[k].shape != own[k].shape
    )
    faults = [
        f"{what} {', '.join(names)}"
        for what, names in (("missing:", missing), ("extra:", extra), ("of another shape:", shapes))
        if names
    ]
    if faults:
        raise UserError(f"{origin} does not fit the network; {'; '.join(faults)}")
    bad = sorted(k for k, v in weights.items() if not torch.isfinite(v.float()).all())
    if bad:
        raise UserError(f"{origin} holds values that are not finite in {', '.join(bad)}: the file is damaged")
    model.load_state_dict({**own, **{k: v.to(own[k].dtype) for k, v in weights.items()}})


def _as_stored(value: Tensor, dtype: torch.dtype) -> Tensor:
    """The tensor in a type to store, unless its values would overflow: BatchNorm's variances exceed float16's 65504."""
    if not value.is_floating_point():
        return value
    cast = value.to(dtype)
    return cast if torch.isfinite(cast).all() else value
