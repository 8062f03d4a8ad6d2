"""Engines: what cannot be opened says why, and the torch engine is the network itself."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from psiamfcpp import UserError, zoo
from psiamfcpp.geometry import Image
from psiamfcpp.models import load
from psiamfcpp.runtime import ENGINES, open_engine


@pytest.fixture(autouse=True)
def threads_as_before() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def noise(side: int) -> Image:
    return np.random.default_rng(side).integers(0, 256, (side, side, 3), dtype=np.uint8)


def as_input(crop: Image) -> torch.Tensor:
    return torch.tensor(crop.transpose(2, 0, 1)[None].astype(np.float32))


@pytest.mark.parametrize("engine", [None, *ENGINES])
@pytest.mark.parametrize(("search_size", "cells"), [(None, 17), (239, 9)])
def test_an_engine_is_the_network(tiny_model: Path, engine: str | None, search_size: int | None, cells: int) -> None:
    opened = open_engine(str(tiny_model), engine, 1, search_size)
    side = opened.spec.search_size
    assert side == (search_size or 303)
    z, x = noise(127), noise(side)
    scores, boxes = opened.search(x, opened.template(z))
    assert (scores.shape, boxes.shape) == ((cells, cells), (cells, cells, 4))
    assert scores.dtype == boxes.dtype == np.float32
    network = load(tiny_model)
    with torch.no_grad():
        expected_scores, expected_boxes = network.search(as_input(x), network.template(as_input(z)))
    assert_allclose(scores, expected_scores[0], atol=1e-4)
    assert_allclose(boxes, expected_boxes[0], rtol=1e-4, atol=1e-4)


def test_kernels_outlive_the_buffer_of_their_crop(tiny_model: Path) -> None:
    opened = open_engine(str(tiny_model), threads=1)
    z, x = noise(127), noise(303)
    kernels = opened.template(z)
    before, _ = opened.search(x, kernels)
    kept = before.copy()
    z[:] = 0
    after, _ = opened.search(x, kernels)
    assert_allclose(after, kept, atol=1e-6)
    opened.search(noise(303) // 2, kernels)
    assert_allclose(after, kept, atol=1e-6)  # nor does a later search overwrite an earlier result


def test_threads_are_set(tiny_model: Path) -> None:
    open_engine(str(tiny_model), "torch", threads=2)
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"engine": "tensorflow"}, r"unknown engine 'tensorflow': known are .*torch"),
        ({"engine": ""}, "unknown engine ''"),
        ({"threads": 0}, "threads is 0: it must be at least 1"),
        ({"threads": -3}, "threads is -3"),
        ({"search_size": 300}, "search size 300 is not 127 plus a multiple of 8: try 239 or 303"),
        ({"search_size": 127}, "search size 127 leaves a score map"),
        ({"search_size": 0}, "search size 0"),
        ({"model": "no/such/model.safetensors"}, "'no/such/model.safetensors' is neither a file nor a shipped model"),
    ],
)
def test_what_cannot_be_opened_says_why(tiny_model: Path, options: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        open_engine(**{"model": str(tiny_model), **options})  # type: ignore[arg-type]


def test_an_unknown_model_names_the_nearest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "siamfcpp-alexnet.safetensors").touch()
    monkeypatch.setattr(zoo, "_FOLDER", tmp_path)
    with pytest.raises(UserError, match=r"model 'siamfcpp-alexnt' .* did you mean 'siamfcpp-alexnet'"):
        open_engine("siamfcpp-alexnt")


def test_without_torch_the_install_line_is_given(tiny_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "psiamfcpp.runtime.torch_engine", raising=False)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(UserError, match=r"torch.*pip install 'psiamfcpp\[train\]'"):
        open_engine(str(tiny_model), "torch")
