"""The core installs without torch: what does not need it must run, and what does must say so."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

_NAMES = ("torch", "safetensors", "matplotlib", "onnx", "openvino", "av", "scipy")
# A finder before all others, so that these fail as if not installed; None in sys.modules would fool libraries that
# ask there whether torch is in use.
_WITHOUT = f"""
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {_NAMES}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
"""


def _python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", _WITHOUT + code], capture_output=True, text=True, check=False)


def test_the_library_and_every_command_without_torch_can_be_imported() -> None:
    commands = "demo, track, serve, evaluate, score, report, datasets, info, import_, bench, export"
    done = _python(f"import psiamfcpp; from psiamfcpp.cli import {commands}")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "args",
    [
        ["info", "siamfcpp-alexnet"],
        ["demo", "--frames", "2", "--engine", "torch", "--model", "siamfcpp-alexnet"],
        ["export", "siamfcpp-alexnet", "-o", "x"],
        ["import", "x.pkl", "-o", "y.safetensors"],
        ["train", "--data", "folder:.", "--init", "x", "-o", "y"],
        ["rank", "siamfcpp-alexnet", "--data", "folder:.", "-o", "y.json"],
        ["plan", "ranks.json", "--remove", "0.5"],
        ["prune", "siamfcpp-alexnet", "--plan", "x.json", "-o", "y.safetensors"],
        ["sensitivity", "siamfcpp-alexnet", "--ranks", "x.json", "--root", ".", "-o", "y"],
    ],
    ids=lambda args: args[0],
)
def test_what_needs_torch_says_how_to_get_it(args: list[str]) -> None:
    done = _python(f"from psiamfcpp.cli import main; sys.exit(main({args!r}))")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "pip install 'psiamfcpp[train]'" in done.stderr


@pytest.mark.parametrize(
    ("missing", "args", "extra"),
    [
        ("fastapi starlette uvicorn websockets", ["serve", "x"], "serve"),
        ("websockets", ["serve", "x"], "serve"),
        ("pymavlink", ["serve", "x", "--port", "0", "--mavlink", "udpin:127.0.0.1:14572"], "mavlink"),
        ("serial", ["serve", "x", "--port", "0", "--mavlink", "serial:/dev/null"], "mavlink"),
    ],
)
def test_what_serving_needs_says_how_to_get_it(missing: str, args: list[str], extra: str) -> None:
    code = f"import sys; sys.modules.update(dict.fromkeys({missing.split()!r}));"
    code += f"from psiamfcpp.cli import main; sys.exit(main({args!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert f"pip install 'psiamfcpp[{extra}]'" in done.stderr


def test_the_demo_runs_on_the_shipped_graphs(tmp_path: Path) -> None:
    args = ["demo", "--frames", "4", "--threads", "1", "--json", "-o", str(tmp_path / "demo.mp4")]
    done = _python(f"from psiamfcpp.cli import main; sys.exit(main({args!r}))")
    assert (done.returncode, done.stderr) == (0, "")
    told = json.loads(done.stdout)
    assert told["frames"] == 4
    assert (tmp_path / "demo.mp4").stat().st_size > 0
