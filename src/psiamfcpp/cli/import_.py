"""`psiamfcpp import`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro


def import_(
    checkpoint: Annotated[Path, tyro.conf.Positional], output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
) -> None:
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
