"""`psiamfcpp import`."""

from __future__ import annotations

from pathlib import Path

import tyro

from psiamfcpp.cli.arguments import Output, Overwrite
from psiamfcpp.cli.output import check_new
from psiamfcpp.files import check_outputs
from psiamfcpp.models.cost import facts
from psiamfcpp.recipes.importing import import_model


def import_(checkpoint: tyro.conf.Positional[tuple[Path, ...]], output: Output, overwrite: Overwrite = False) -> None:
    """Convert an official SiamFC++ (AlexNet) checkpoint, or the deployed graphs of LightFC; no code in them is run.

    Args:
        checkpoint: the official .pkl or .pth file, or LightFC's graphs of the template and of the search crop, .onnx.
        output: checkpoint to write, .safetensors.
    """
    check_outputs([output], checkpoint)
    check_new([output], overwrite)
    network = import_model(checkpoint, output)
    print(f"{facts(network.spec)['parameters']:,} parameters written to {output}")
