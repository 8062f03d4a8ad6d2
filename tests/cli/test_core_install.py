"""The core installs without torch: what does not need it must run, and what does must say so."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import psiamfcpp_weights
import pytest
from packaging.requirements import Requirement

import psiamfcpp

# a process each
pytestmark = pytest.mark.slow


@pytest.fixture(scope="session")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of libraries that holds what the core requires, what that requires, and nothing else."""
    folder = tmp_path_factory.mktemp("core")
    wanted, known = ["psiamfcpp"], {"psiamfcpp"}
    while wanted:
        distribution = metadata.distribution(wanted.pop())
        for requirement in map(Requirement, distribution.requires or ()):
            name = requirement.name.lower().replace("_", "-")
            if (not requirement.marker or requirement.marker.evaluate({"extra": ""})) and name not in known:
                known.add(name)
                wanted.append(name)
        if distribution.metadata["Name"] != "psiamfcpp":
            for top in {
                file.parts[0] for file in distribution.files or () if file.parts[0] not in ("..", "__pycache__")
            }:
                (folder / top).unlink(missing_ok=True)
                (folder / top).symlink_to(str(distribution.locate_file(top)))
    (folder / "psiamfcpp").symlink_to(Path(psiamfcpp.__file__).parent)
    (folder / "psiamfcpp_weights").symlink_to(Path(psiamfcpp_weights.__file__).parent)
    return folder


def _python(core: Path, code: str) -> subprocess.CompletedProcess[str]:
    """Run code where nothing but the core is installed; -S leaves out the libraries of this environment."""
    environment = {**os.environ, "PYTHONPATH": str(core)}
    return subprocess.run(
        [sys.executable, "-S", "-c", code], env=environment, capture_output=True, text=True, check=False
    )


def test_the_library_and_every_command_without_torch_can_be_imported(core: Path) -> None:
    commands = "demo, track, serve, evaluate, score, report, datasets, info, import_, bench, export"
    done = _python(core, f"import psiamfcpp; from psiamfcpp.cli import {commands}")
    assert (done.returncode, done.stderr) == (0, "")
    for name in ("torch", "safetensors", "matplotlib", "onnx", "openvino", "av", "scipy"):
        assert f"No module named '{name}'" in _python(core, f"import {name}").stderr


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
def test_what_needs_torch_says_how_to_get_it(core: Path, args: list[str]) -> None:
    done = _python(core, f"import sys; from psiamfcpp.cli import main; sys.exit(main({args!r}))")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "pip install 'psiamfcpp[train]'" in done.stderr


def test_a_wrong_name_is_no_reason_to_install_torch(core: Path) -> None:
    done = _python(
        core, "import sys; from psiamfcpp.cli import main; sys.exit(main(['info', 'psiamfcpp-alexnet-int']))"
    )
    assert done.returncode == 2
    assert done.stderr.endswith("did you mean 'psiamfcpp-alexnet-int8'?\n")


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


def test_the_demo_runs_on_the_shipped_graphs(core: Path, tmp_path: Path) -> None:
    args = ["demo", "--frames", "4", "--threads", "1", "--json", "-o", str(tmp_path / "demo.mp4")]
    done = _python(core, f"import sys; from psiamfcpp.cli import main; sys.exit(main({args!r}))")
    assert done.returncode == 0
    assert done.stderr.splitlines() == [
        "video is written as MPEG-4, which browsers do not play: pip install 'psiamfcpp[video]' for H.264"
    ]
    told = json.loads(done.stdout)
    assert told["frames"] == 4
    assert (tmp_path / "demo.mp4").stat().st_size > 0
