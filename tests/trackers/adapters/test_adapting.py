from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from psiamfcpp.trackers.adapters import trax_worker

ADAPTING = Path(trax_worker.__file__).with_name("adapting.py")


@pytest.fixture
def adapting(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module as an adapter imports it: beside the server, not as part of this package."""
    monkeypatch.setitem(sys.modules, "trax_worker", trax_worker)
    spec = importlib.util.spec_from_file_location("adapting", ADAPTING)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module


@pytest.mark.parametrize(
    ("answer", "score"),
    [
        ([1, 2, 3, 4], None),
        (np.arange(1, 5), None),
        ((1, 2, 3, 4), None),
        (([1, 2, 3, 4], 0.5), 0.5),
        ([[1, 2, 3, 4]], None),
    ],
)
def test_what_a_tracker_may_return(adapting: ModuleType, answer: object, score: float | None) -> None:
    box, found = adapting.box_and_score(answer)
    assert box.tolist() == [1, 2, 3, 4] and found == score


@pytest.mark.parametrize("answer", [None, [], [1, 2, 3], "box", {"bbox": [1, 2, 3, 4]}, (None, 0.5), [1, 2, np.nan, 4]])
def test_what_a_tracker_may_not_return(adapting: ModuleType, answer: object) -> None:
    with pytest.raises(ValueError, match="update"):
        adapting.box_and_score(answer)


def test_what_is_left_out_can_be_imported_and_what_is_installed_stays(
    adapting: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "checkout_package").mkdir()
    (tmp_path / "checkout_package" / "datasets.py").write_text("raise RuntimeError('needs much else')")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("no_such_package", "no_such_package.inner", "checkout_package.datasets"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    adapting.leave_out("no_such_package", "no_such_package.inner", "checkout_package.datasets", "numpy")
    namespace: dict[str, object] = {}
    code = "import numpy; from no_such_package.inner import Thing; from checkout_package.datasets import read"
    exec(code, namespace)
    assert isinstance(namespace["Thing"], type)
    assert namespace["numpy"] is np
    for name in ("no_such_package", "no_such_package.inner", "checkout_package.datasets"):
        del sys.modules[name]


def test_names_that_numpy_dropped_are_given_back(adapting: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    before = set(np.__dict__)
    monkeypatch.delitem(np.__dict__, "int", raising=False)
    adapting.adapt_numpy()
    assert np.__dict__["int"] is int and np.__dict__["float"] is float
    for name in set(np.__dict__) - before:
        delattr(np, name)


def test_seeds_repeat_what_is_drawn(adapting: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    drawn = []
    for _ in range(2):
        adapting.seed_everything(threads=1)
        drawn.append(np.random.rand())
    assert drawn[0] == drawn[1]


def test_transforms_that_torch_dropped_are_inverse(adapting: ModuleType) -> None:
    torch = pytest.importorskip("torch")
    signal = torch.rand(2, 1, 5, 6)
    spectrum = adapting._rfft(signal, 2)
    # the last dimension holds real and imaginary parts, the one before it the half of the frequencies
    assert spectrum.shape == (2, 1, 5, 4, 2)
    assert torch.allclose(spectrum[..., 0, 0, 0], signal.sum(dim=(-2, -1)))
    assert torch.allclose(adapting._irfft(spectrum, 2, signal_sizes=(5, 6)), signal, atol=1e-6)
