"""A network of your own in psiamfcpp: two layers of torchvision's AlexNet before SiamFC++'s neck and head.

    python own_network.py start alexnet-owt-7be5be79.pth start.safetensors
    python own_network.py COMMAND ...

The first line makes a checkpoint of torchvision's. After that every command of `psiamfcpp` runs as the second line
does, on this network as on those of the package. docs/own-network.md goes from here to a pruned model in 8 bits.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

from psiamfcpp.cli import main
from psiamfcpp.models import arch
from psiamfcpp.models.arch import PIXELS, Layer
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE as SIAMFCPP
from psiamfcpp.spec import ModelSpec

NAME, MODULE = "alexnet-2", "own_network"
# Filters of neck and head; SiamFC++ has 256.
WIDTH = 64
CONV1, CONV2 = "backbone.conv1", "backbone.conv2"
BACKBONE = (
    Layer(CONV1, (PIXELS,), 64, 11, stride=2, bn=False, pool=(3, 2), group=CONV1, thaw=1.0),
    Layer(CONV2, (CONV1,), 192, 5, bn=False, pool=(3, 2), relu=False, group=CONV2, thaw=1.0),
)
# What torchvision calls these layers.
THEIRS = {CONV1: "features.0", CONV2: "features.3"}


def behind_mine(row: Layer) -> Layer:
    """Return a row of SiamFC++'s neck or head as it stands behind another backbone."""
    reads = (CONV2,) if row.part == "neck" else row.reads
    return dataclasses.replace(row, reads=reads, width=WIDTH if row.group else row.width)


LAYERS = (*BACKBONE, *(behind_mine(row) for row in SIAMFCPP.layers if row.part != "backbone"))
ARCHITECTURE = dataclasses.replace(SIAMFCPP, layers=LAYERS, presets={})
arch.ARCHITECTURES[NAME] = MODULE


def start(checkpoint: Path, output: Path) -> None:
    """Write a model with torchvision's weights in the backbone, and random ones in neck and head."""
    import torch

    from psiamfcpp.models import SiamFCpp, save
    from psiamfcpp.models.alexnet import fold_preprocessing
    from psiamfcpp.models.checkpoint import fit
    from psiamfcpp.models.initial import init_neck_and_head

    network = SiamFCpp(ModelSpec(search_size=239, calibration=None, architecture=NAME))
    init_neck_and_head(network)
    theirs, weights = torch.load(checkpoint, weights_only=True), network.state_dict()
    for own, name in THEIRS.items():
        pair = theirs[f"{name}.weight"], theirs[f"{name}.bias"]
        # Theirs read RGB less its mean; the package gives BGR, 0..255.
        pair = fold_preprocessing(*pair) if own == CONV1 else pair
        weights[f"{own}.conv.weight"], weights[f"{own}.conv.bias"] = pair
    fit(network, weights, str(checkpoint))
    save(output, network)


if __name__ == "__main__":
    if sys.argv[1:2] == ["start"]:
        start(*map(Path, sys.argv[2:]))
    else:
        sys.exit(main())
