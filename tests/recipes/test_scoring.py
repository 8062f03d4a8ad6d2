"""What the training loss says of filters, for an architecture whose losses are its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_pruning")
from models.deployed import TABLE, random_lightfc  # noqa: E402 - torch comes first
from psiamfcpp import datasets  # noqa: E402
from psiamfcpp.pruning import CRITERIA, Context, scores  # noqa: E402
from psiamfcpp.pruning.models import example_inputs, groups_of  # noqa: E402
from psiamfcpp.recipes.scoring import loss_gradients  # noqa: E402
from psiamfcpp.training.options import PairOptions, TrainOptions  # noqa: E402


@pytest.mark.slow
def test_taylor_knows_what_the_loss_of_lightfc_depends_on(blob_sequence: Callable[..., Path]) -> None:
    root = blob_sequence("ride", [(100 + 3 * t, 80, 40, 30) for t in range(4)])
    network = random_lightfc(widths=dict.fromkeys(TABLE.groups, 4))
    with torch.no_grad():
        network.get_submodule("head.score3").conv.weight[:, 1] = 0  # type: ignore[union-attr,operator]
    options = TrainOptions(pairs=PairOptions(search_size=256), batch=1)
    gradients = loss_gradients(network, datasets.read("folder", root), options)
    groups = groups_of(network.spec)
    found = scores(groups, Context(network, example_inputs(network.spec), gradients=gradients), CRITERIA["taylor"])
    worth = found["head.score2"]
    assert worth[1] == 0 < worth.max()
    # Nothing of the random size head is alive: its filters are worth nothing, and that is no error.
    assert not found["head.size1"].any()
