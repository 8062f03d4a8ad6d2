"""Convert checkpoints and graphs of others."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from psiamfcpp.errors import UserError
from psiamfcpp.files import check_outputs

if TYPE_CHECKING:
    from psiamfcpp.models import Network


def import_model(files: Sequence[str | Path], output: str | Path | None = None) -> Network:
    """Convert an official SiamFC++ (AlexNet) checkpoint, or the deployed graphs of LightFC; no code in them is run.

    Args:
        files: the official .pkl or .pth file, or LightFC's graphs of the template and of the search crop, .onnx.
        output: checkpoint to write, .safetensors.

    Returns:
        The network.

    Raises:
        UserError: a file cannot be read or written, or holds something else.
    """
    paths = [Path(path) for path in files]
    output = None if output is None else Path(output)
    check_outputs([output], paths)
    from psiamfcpp.models import save
    from psiamfcpp.models.lightfc_import import import_lightfc
    from psiamfcpp.models.official import import_official

    if len(paths) not in (1, 2):
        raise UserError(f"{len(paths)} files to import: give one checkpoint of SiamFC++, or LightFC's two graphs")
    network: Network = import_official(*paths) if len(paths) == 1 else import_lightfc(*paths)
    if output:
        save(output, network)
    return network
