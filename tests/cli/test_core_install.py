"""The core installs without torch: what does not need it must run, and what does must say so."""

from __future__ import annotations

import subprocess
import sys

import pytest

# None in sys.modules makes the import fail as if the package were not installed.
_WITHOUT = "import sys; sys.modules.update(dict.fromkeys(('torch', 'safetensors', 'matplotlib', 'av', 'scipy')));"


def _python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", _WITHOUT + code], capture_output=True, text=True, check=False)


def test_the_library_and_every_command_without_torch_can_be_imported() -> None:
    done = _python("import psiamfcpp; from psiamfcpp.cli import demo, track, evaluate, score, datasets, info, import_")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "args",
    [
        ["info", "siamfcpp-alexnet"],
        ["demo", "--frames", "2"],
        ["import", "x.pkl", "-o", "y.safetensors"],
        ["train", "--data", "folder:.", "--init", "x", "-o", "y"],
    ],
    ids=lambda args: args[0],
)
def test_what_needs_torch_says_how_to_get_it(args: list[str]) -> None:
    done = _python(f"from psiamfcpp.cli import main; sys.exit(main({args!r}))")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "pip install 'psiamfcpp[train]'" in done.stderr
