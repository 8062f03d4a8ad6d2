from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from psiamfcpp.errors import UserError
from psiamfcpp.files import (
    check_file,
    check_outputs,
    parse_json,
    printable,
    read_bytes,
    read_json,
    read_table,
    read_text,
    whole,
    write_whole,
)

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
        for name in (source, link, tmp_path, str(tmp_path / "a*.mp4")):
            with pytest.raises(UserError, match=r"output .* is the input .*: choose another name"):
                check_outputs([output], [None, "rtsp://camera", name])
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


@pytest.mark.parametrize(
    "content",
    ["1,2\né\n".encode(), "1,2\né\n".encode("utf-8-sig"), "1,2\né\n".encode("utf-16")],
    ids=["utf-8", "mark", "utf-16"],
)
def test_text_with_any_byte_order_mark(tmp_path: Path, content: bytes):
    (tmp_path / "a.txt").write_bytes(content)
    assert read_text(tmp_path / "a.txt", "boxes") == "1,2\né\n"
    assert [(line, list(row.items())) for line, row in read_table(tmp_path / "a.txt", "table")] == [
        (2, [("1", "é"), ("2", "")])
    ]


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _huge(path: Path) -> None:
    path.touch()
    os.truncate(path, 2**40)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "boxes .*a.txt does not exist: fetch it"),
        (lambda path: path.mkdir(), "boxes .*a.txt is not a file: fetch it"),
        (_pipe, "boxes .*a.txt is not a file: fetch it"),
        (_huge, r"boxes .*a.txt has 1,099,511,627,776 bytes, at most .* are read: fetch it"),
        (lambda path: path.write_bytes(b"a\xff"), r"boxes .*a.txt cannot be read \(it is no text, .*\): fetch it"),
        (lambda path: path.symlink_to(path), r"boxes .*a.txt cannot be read \(Too many levels .*\): fetch it"),
    ],
    ids=["missing", "folder", "pipe", "huge", "no text", "circle"],
)
def test_what_cannot_be_read_as_text(tmp_path: Path, make: Callable[[Path], object], message: str):
    make(tmp_path / "a.txt")
    with pytest.raises(UserError, match=message):
        read_text(tmp_path / "a.txt", "boxes", "fetch it")


@pytest.mark.parametrize("name", ["a" * 500, "a\0b"])
@pytest.mark.parametrize("read", [read_bytes, check_file])
def test_impossible_names(tmp_path: Path, read: Callable[[Path, str], object], name: str):
    with pytest.raises(UserError, match=r"boxes .* cannot be read"):
        read(tmp_path / name, "boxes")


def test_a_name_that_is_not_utf8_is_not_handed_to_libraries(tmp_path: Path):
    path = tmp_path / os.fsdecode(b"\xff\xfe.bin")
    path.write_bytes(b"abc")
    assert read_bytes(path, "file") == b"abc"
    with pytest.raises(UserError, match="its name is not UTF-8: rename it"):
        check_file(path, "file")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "plan is not JSON"),
        ("[" * 65 + "]" * 65, "nested more than 64 deep"),
        ('{"a":' * 65 + "1" + "}" * 65, "nested more than 64 deep"),
        ("9" * 400, "a number of 400 digits"),
        ("-" + "9" * 5000, "a number of 5000 digits"),
        ("{", "plan is not JSON"),
        ("", "plan is not JSON"),
    ],
)
def test_json_without_bounds_is_refused(text: str, message: str):
    with pytest.raises(UserError, match=message) as caught:
        parse_json(text, "plan")
    assert len(str(caught.value)) < 300


@settings(max_examples=30)
@given(st.recursive(st.none() | st.booleans() | st.text() | st.integers(-(10**299), 10**299), st.lists, max_leaves=20))
def test_json_within_bounds_is_read(value: object):
    assert parse_json(json.dumps(value), "plan") == value


def test_json_of_a_file_is_named(tmp_path: Path):
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(UserError, match=r"plan .*a\.json is not JSON"):
        read_json(tmp_path / "a.json", "plan")


@given(st.text(st.characters(codec=None)))
def test_printable_text_moves_no_cursor_and_can_be_encoded(text: str):
    shown = printable(text)
    assert shown.isprintable()
    shown.encode()


def test_names_that_are_not_utf8_are_written_as_they_are(tmp_path: Path):
    write_whole(tmp_path / "a.csv", os.fsdecode(b"\xff,1\n"))
    assert (tmp_path / "a.csv").read_bytes() == b"\xff,1\n"
