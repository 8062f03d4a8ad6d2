"""benchmarks/agreement.py: models agree with themselves, and less with others."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from psiamfcpp.errors import UserError


@pytest.mark.slow
def test_a_model_agrees_with_itself_and_less_with_another(
    script: ModuleType,
    tiny_model: Path,
    make_network: Callable[..., Any],
    tmp_path: Path,
    blob_sequence: Callable[..., Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    from psiamfcpp.models import save

    other = tmp_path / "other.safetensors"
    network = make_network(5)
    # A model of another search size takes the crops of the first.
    network.spec = dataclasses.replace(network.spec, search_size=network.spec.search_size + 32)
    save(other, network)
    data = (f"folder:{blob_sequence('blob', [(100, 80, 40, 30)] * 3)}",)
    script.main((str(tiny_model), str(tiny_model), str(other)), data, held_out_every=1, pairs=4)
    same, different = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r".*tiny\.safetensors: same cell 1\.000, overlap 1\.000, least 1\.000, time \d+\.\d\d", same)
    assert float(different.split("overlap ")[1].split(",")[0]) < 1

    with pytest.raises(UserError, match="1 models given: two or more"):
        script.main((str(tiny_model),), data)
