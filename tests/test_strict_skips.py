"""A test that is skipped without leave fails a strict run: tests/conftest.py in a folder of other tests."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = """
import pytest

def test_passes(): pass
def test_unlucky(): pytest.xfail("known")
@pytest.mark.skip(reason="no shared data")
def test_data(): pass
@pytest.mark.skipif(True, reason="no browser")
def test_page(): pass
"""
A, B = "tests/test_a.py", "tests/test_b.py"
WHOLE_FILE = 'import pytest\npytest.importorskip("no_such_library")\n'


@pytest.mark.slow
@pytest.mark.parametrize(
    ("strict", "workers", "allowed", "named"),
    [
        ("0", 0, "", []),
        ("1", 2, "tests/test_a.py  # all of it\ntests/test_b.py", []),
        *(("1", n, "# tests/test_a.py\n\ntests/test_a.py::test_page", [f"{A}::test_data", B]) for n in (0, 2)),
    ],
)
def test_skips_that_nobody_allowed_fail_the_run(
    tmp_path: Path, strict: str, workers: int, allowed: str, named: list[str]
) -> None:
    folder = tmp_path / "tests"
    folder.mkdir()
    shutil.copy(Path(__file__).with_name("conftest.py"), folder)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = slow\n")
    (folder / "test_a.py").write_text(TESTS)
    (folder / "test_b.py").write_text(WHOLE_FILE)
    (folder / "allowed_skips.txt").write_text(allowed)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", str(workers), str(folder)],
        env={**os.environ, "PSIAMFCPP_STRICT_SKIPS": strict},
        cwd=Path.home(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == bool(named), done.stdout
    complaints = [line.split(",")[0].split()[1] for line in done.stdout.splitlines() if "does not name" in line]
    assert sorted(complaints) == named
    assert all(why in done.stdout for why in (["no shared data", "no_such_library"] if named else []))
