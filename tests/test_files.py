from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.files import check_outputs, whole, write_whole

OLD = "old content\n"


@pytest.fixture
def old(tmp_path: Path) -> Path:
    path = tmp_path / "file.txt"
    path.write_text(OLD)
    return path


def listed(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize(
    ("content", "expected"),
    [("a\nb\r\n\u00e9", b"a\nb\r\n\xc3\xa9"), (b"\0\xff", b"\0\xff"), (memoryview(b"abc"), b"abc"), ("", b"")],
)
def test_content_arrives_byte_for_byte(old: Path, content: str | bytes | memoryview, expected: bytes):
    write_whole(old, content)
    assert old.read_bytes() == expected
    assert listed(old.parent) == ["file.txt"]


def test_missing_folders_are_made(tmp_path: Path):
    write_whole(tmp_path / "a" / "b" / "file.txt", "x")
    assert listed(tmp_path) == ["a", "a/b", "a/b/file.txt"]


def test_the_old_file_stays_until_the_block_ends(old: Path):
    with whole(old) as temporary:
        temporary.write_text("new")
        assert old.read_text() == OLD
    assert old.read_text() == "new"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_in_the_block_keeps_the_old_file(old: Path, error: type[BaseException]):
    with pytest.raises(error), whole(old) as temporary:
        temporary.write_text("half")
        raise error
    assert old.read_text() == OLD
    assert listed(old.parent) == ["file.txt"]


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_a_process_killed_while_writing_leaves_the_old_file(old: Path):
    script = "import os, pathlib, signal, sys; from psiamfcpp.files import whole\n"
    script += "with whole(pathlib.Path(sys.argv[1])) as temporary:\n"
    script += "    temporary.write_text('half')\n    os.kill(os.getpid(), signal.SIGKILL)\n"
    assert subprocess.run([sys.executable, "-c", script, str(old)]).returncode == -signal.SIGKILL
    assert old.read_text() == OLD
    # What such a process leaves behind is hidden from every listing, and in nobody's way.
    assert all(name.startswith(".") for name in listed(old.parent) if name != "file.txt")
    write_whole(old, "new")
    assert old.read_text() == "new"


def test_a_full_disk(old: Path, disk_of: Callable[[int], AbstractContextManager[None]]):
    with disk_of(100), pytest.raises(UserError, match=r"file\.txt cannot be written \(File too large\)") as caught:
        write_whole(old, bytes(1000))
    assert "\n" not in str(caught.value)
    assert old.read_text() == OLD
    assert listed(old.parent) == ["file.txt"]


def test_a_folder_in_place_of_the_file(tmp_path: Path):
    (tmp_path / "file.txt").mkdir()
    with pytest.raises(UserError, match=r"file\.txt cannot be written"):
        write_whole(tmp_path / "file.txt", "x")
    assert listed(tmp_path) == ["file.txt"]


def test_a_file_in_place_of_the_folder(old: Path):
    with pytest.raises(UserError, match="cannot be written"):
        write_whole(old / "inner.txt", "x")
    assert old.read_text() == OLD


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_must_not_be_written_to(old: Path):
    old.parent.chmod(0o555)
    try:
        with pytest.raises(UserError, match="cannot be written"):
            write_whole(old, "new")
    finally:
        old.parent.chmod(0o755)
    assert old.read_text() == OLD


@pytest.mark.skipif(os.name != "posix", reason="modes of POSIX")
@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o002, 0o664), (0o077, 0o600)])
def test_the_mode_follows_the_umask_whatever_the_writer_does(tmp_path: Path, umask: int, mode: int):
    before = os.umask(umask)
    try:
        with whole(tmp_path / "file.txt") as temporary:
            temporary.unlink()
            temporary.touch(mode=0o600)
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "file.txt").stat().st_mode) == mode


def test_an_output_that_is_an_input_is_refused_whatever_its_name(tmp_path: Path) -> None:
    source, link, other = tmp_path / "a.mp4", tmp_path / "link.mp4", tmp_path / "other.mp4"
    source.write_bytes(b"a")
    other.write_bytes(b"b")
    link.symlink_to(source)
    for output in (source, link, tmp_path / "x" / ".." / "a.mp4"):
        (tmp_path / "x").mkdir(exist_ok=True)
        for given in (source, link, tmp_path, str(tmp_path / "a*.mp4")):
            with pytest.raises(UserError, match=r"output .* is the input .*: choose another name"):
                check_outputs([output], [None, "rtsp://camera", given])
    check_outputs([other, None, tmp_path / "new.mp4"], [source, "siamfcpp-alexnet"])


def test_two_outputs_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is named twice"):
        check_outputs([tmp_path / "a.txt", tmp_path / "a.txt"], [])


def test_a_broken_link_hides_no_other_file_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "0.jpg").symlink_to(tmp_path / "nowhere.jpg")
    (tmp_path / "1.jpg").write_bytes(b"image")
    with pytest.raises(UserError, match="is the input"):
        check_outputs([tmp_path / "1.jpg"], [tmp_path])
    check_outputs([tmp_path / "2.jpg"], ["\0", "x" * 5000])
