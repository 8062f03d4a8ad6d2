"""`psiamfcpp import`."""

from __future__ import annotations

from pathlib import Path

import tyro

from psiamfcpp.cli.arguments import Output


def import_(checkpoint: tyro.conf.Positional[Path], output: Output) -> None:
    """Convert an official SiamFC++ (AlexNet) checkpoint; nothing in it is run.

    Args:
        checkpoint: the official .pkl or .pth file.
        output: checkpoint to write, .safetensors.
    """
    from psiamfcpp.models import save
    from psiamfcpp.models.cost import count_parameters
    from psiamfcpp.models.official import import_official

    model = import_official(checkpoint)
    save(output, model)
    print(f"{count_parameters(model):,} parameters written to {output}")
