"""benchmarks/agreement.py: models agree with themselves, and less with others."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from psiamfcpp.errors import UserError


def test_a_model_agrees_with_itself_and_less_with_another(
    tiny_model: Path,
    make_network: Callable[..., object],
    tmp_path: Path,
    blob_sequence: Callable[..., Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    from psiamfcpp.models import save

    path = Path(__file__).parents[2] / "benchmarks" / "agreement.py"
    spec = importlib.util.spec_from_file_location("agreement", path)
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)

    other = tmp_path / "other.safetensors"
    save(other, make_network(5))
    data = (f"folder:{blob_sequence('blob', [(100, 80, 40, 30)] * 3)}",)
    script.main((str(tiny_model), str(tiny_model), str(other)), data, held_out_every=1, pairs=4)
    same, different = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r".*tiny\.safetensors: same cell 1\.000, overlap 1\.000, least 1\.000, time \d+\.\d\d", same)
    assert float(different.split("overlap ")[1].split(",")[0]) < 1

    with pytest.raises(UserError, match="1 models given: two or more"):
        script.main((str(tiny_model),), data)
