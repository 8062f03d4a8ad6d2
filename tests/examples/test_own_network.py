"""`examples/own_network.py` adds an architecture, and every command of docs/own-network.md runs with it."""

from __future__ import annotations

import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from numpy.testing import assert_allclose

from psiamfcpp.errors import UserError
from psiamfcpp.models.arch import ARCHITECTURES

torch = pytest.importorskip("torch")
from torch import nn  # noqa: E402 - torch comes first

ROOT = Path(__file__).parents[2]
NAME = "alexnet-2"
SCRIPT, PAGE = ROOT / "examples" / "own_network.py", ROOT / "docs" / "own-network.md"
# What the page asks for in hundreds is tried with a few.
FEW = {"--steps": "8", "--batch": "2", "--images": "2", "--pairs": "16", "--validation-pairs": "2", "--frames": "3"}


@pytest.fixture
def mine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """The example, imported as a user's own module is, in an empty folder."""
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    # Set before the import sets it, so that it goes with the test.
    monkeypatch.setitem(ARCHITECTURES, NAME, "own_network")
    monkeypatch.chdir(tmp_path)
    return importlib.import_module("own_network")


@pytest.fixture
def theirs() -> nn.Sequential:
    """Layers of torchvision's shapes and names, with random weights; what lies between is as in the table."""
    torch.manual_seed(0)
    pool = nn.MaxPool2d(3, 2)
    return nn.Sequential(nn.Conv2d(3, 64, 11, 2), nn.ReLU(), pool, nn.Conv2d(64, 192, 5), pool).eval()


def saved(theirs: nn.Sequential, path: Path) -> Path:
    torch.save({f"features.{name}": value for name, value in theirs.state_dict().items()}, path)
    return path


def test_the_backbone_of_a_checkpoint_sees_what_it_saw(mine: ModuleType, theirs: nn.Sequential, tmp_path: Path) -> None:
    from psiamfcpp.models import load

    mine.start(saved(theirs, tmp_path / "theirs.pth"), tmp_path / "start.safetensors")
    network = load(tmp_path / "start.safetensors")
    pixels = torch.rand(1, 3, 239, 239) * 255
    mean, std = (torch.tensor(v)[:, None, None] for v in ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]))
    with torch.no_grad():
        wanted = theirs((pixels.flip(1) / 255 - mean) / std)
        assert_allclose(network.features(pixels), wanted, atol=1e-3 * float(wanted.abs().max()))


def test_a_checkpoint_of_another_shape_is_refused(mine: ModuleType, theirs: nn.Sequential, tmp_path: Path) -> None:
    theirs[3] = nn.Conv2d(64, 100, 5)
    with pytest.raises(UserError, match=r"theirs\.pth does not fit .* backbone\.conv2\.conv\.weight"):
        mine.start(saved(theirs, tmp_path / "theirs.pth"), tmp_path / "start.safetensors")
    assert not (tmp_path / "start.safetensors").exists()


def test_the_package_alone_says_where_the_architecture_is_missing(
    mine: ModuleType, theirs: nn.Sequential, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from psiamfcpp.models import load

    mine.start(saved(theirs, tmp_path / "theirs.pth"), tmp_path / "start.safetensors")
    monkeypatch.delitem(ARCHITECTURES, NAME)
    with pytest.raises(UserError, match=r"unknown architecture 'alexnet-2': known are .*; import the module"):
        load(tmp_path / "start.safetensors")


def commands() -> list[list[str]]:
    """Arguments of each command of the page that runs the example."""
    text = PAGE.read_text().replace("\\\n", " ")
    return [shlex.split(line)[2:] for line in re.findall(r"^(?:    )?(python own_network\.py .*)$", text, re.MULTILINE)]


def with_few(args: list[str]) -> list[str]:
    return [FEW.get(before, arg) for before, arg in zip(["", *args], args, strict=False)]


@pytest.mark.slow
def test_the_commands_of_the_page(
    mine: ModuleType,
    theirs: nn.Sequential,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # 16 pairs leave many cells nearly alike; which of them 8 bits choose depends on the processor.
    monkeypatch.setattr("psiamfcpp.export.parity._OVERLAP", 0.0)
    (rides,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    exec(rides.replace("frames=24", "frames=4"))
    given = commands()
    assert [args[0] for args in given] == ["start", "train", "plan", "prune", "export", "demo"]
    mine.start(saved(theirs, tmp_path / given[0][1]), tmp_path / given[0][2])
    for args in given[1:]:
        assert mine.main([*with_few(args), *["--workers", "0"] * (args[0] == "train")]) == 0, args
    assert re.search(r"precision 0\.\d+, AUC 0\.\d+ over", capsys.readouterr().out)


@pytest.mark.slow
def test_the_file_is_a_command(theirs: nn.Sequential, tmp_path: Path) -> None:
    saved(theirs, tmp_path / "theirs.pth")
    for args in (["start", "theirs.pth", "start.safetensors"], ["info", "start.safetensors"]):
        done = subprocess.run(
            [sys.executable, str(SCRIPT), *args], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stderr) == (0, "")
    assert "architecture alexnet-2" in done.stdout


def test_the_page_counts_its_lines() -> None:
    code = [line for line in SCRIPT.read_text().splitlines() if not re.fullmatch(r" *(#.*)?", line)]
    assert f"prints {len(code)}" in PAGE.read_text()
