"""The fuzz of the readers, in short, and that it notices what a reader must not do."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from psiamfcpp.errors import UserError

FOLDER = Path(__file__).parents[2] / "benchmarks"
# Those that take no more than a millisecond or two; the others wait for libraries.
QUICK = ("boxes", "times", "labels", "attributes", "mat", "run", "stills", "coco", "xml", "list", "uav", "spec", "plan")


@pytest.fixture(scope="module")
def fuzz() -> ModuleType:
    sys.path.insert(0, str(FOLDER))
    spec = importlib.util.spec_from_file_location("fuzz", FOLDER / "fuzz.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fuzz"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", QUICK)
def test_whole_files_are_read_and_damaged_ones_at_least_refused(fuzz: ModuleType, name: str, tmp_path: Path) -> None:
    seed = fuzz.SEEDS[name](tmp_path)
    for content in seed.contents:
        seed.place.write_bytes(content)
        seed.read(seed.place)
    faults = [fuzz.attempt(seed, seed.place, fuzz.case(name, seed, number)) for number in range(100)]
    assert [fault for fault in faults if fault] == []


def test_a_case_is_the_same_each_time_and_no_other(fuzz: ModuleType, tmp_path: Path) -> None:
    seed = fuzz.SEEDS["boxes"](tmp_path)
    cases = [fuzz.case("boxes", seed, number) for number in range(50)]
    assert cases == [fuzz.case("boxes", seed, number) for number in range(50)]
    assert len(set(cases)) > 40


@pytest.mark.parametrize(
    ("error", "fails"),
    [(None, False), (UserError("damaged"), False), (UserError("x" * 9000), True), (KeyError(), True)],
)
def test_anything_but_one_line_of_ours_is_a_fault(
    fuzz: ModuleType, tmp_path: Path, error: Exception | None, fails: bool
) -> None:
    def read(_: Path) -> None:
        if error is not None:
            raise error

    seed = fuzz.Seed(tmp_path / "a", [b"abc"], read)
    assert (fuzz.attempt(seed, seed.place, b"abc") is not None) == fails


def _crashing(folder: Path) -> Any:
    from fuzz_seeds import Seed

    def read(path: Path) -> None:
        if len(path.read_bytes()) > 27:
            os.kill(os.getpid(), signal.SIGSEGV)

    return Seed(folder / "a", [b"abc" * 9], read)


@pytest.mark.slow
def test_a_reader_that_ends_its_process_is_seen(fuzz: ModuleType) -> None:
    longer = [number for number in range(10) if len(fuzz.case("a", _crashing(Path()), number)) > 27][:2]
    done, faults = fuzz.run("a", _crashing, 0, longer[-1] + 2)
    assert (done, [number for number, _ in faults]) == (longer[-1] + 2, longer)
    assert {text for _, text in faults} == {f"the process ended with {-signal.SIGSEGV}"}
