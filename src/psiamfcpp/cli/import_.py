"""`psiamfcpp import`."""

from __future__ import annotations

from pathlib import Path

import tyro

from psiamfcpp.cli.arguments import Output, Overwrite
from psiamfcpp.cli.output import check_new
from psiamfcpp.errors import UserError
from psiamfcpp.files import check_outputs


def import_(checkpoint: tyro.conf.Positional[tuple[Path, ...]], output: Output, overwrite: Overwrite = False) -> None:
    """Convert an official SiamFC++ (AlexNet) checkpoint, or the deployed graphs of LightFC; no code in them is run.

    Args:
        checkpoint: the official .pkl or .pth file, or LightFC's graphs of the template and of the search crop, .onnx.
        output: checkpoint to write, .safetensors.
    """
    check_outputs([output], checkpoint)
    check_new([output], overwrite)
    from psiamfcpp.models import save
    from psiamfcpp.models.cost import count_parameters
    from psiamfcpp.models.network import Network
    from psiamfcpp.models.official import import_official

    if len(checkpoint) == 2:
        from psiamfcpp.models.lightfc_import import import_lightfc

        model: Network = import_lightfc(*checkpoint)
    elif len(checkpoint) == 1:
        model = import_official(*checkpoint)
    else:
        raise UserError(f"{len(checkpoint)} files to import: give one checkpoint of SiamFC++, or LightFC's two graphs")
    save(output, model)
    print(f"{count_parameters(model):,} parameters written to {output}")
