"""What holds for every command: help, versions, and one line for every mistake."""

from __future__ import annotations

import importlib
import inspect
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import psiamfcpp
from psiamfcpp.cli import COMMANDS, _gathered, _one_line, _parse
from psiamfcpp.cli.examples import EXAMPLES, GROUPS
from psiamfcpp.errors import UserError

from .conftest import Run

REQUIRED = {
    "track": "SOURCE",
    "info": "MODEL",
    "serve": "SOURCE",
    "evaluate": "--root",
    "score": "--annotations",
    "report": "--output",
    "train": "--data",
    "calibrate": "--data",
    "import": "PATH",
}


@pytest.mark.parametrize("args", [[], ["-h"], ["--help"], ["help"]])
def test_the_overview_lists_every_command(run: Run, args: list[str]) -> None:
    ended = run(*args)
    assert (ended.code, ended.err) == (0, "")
    for name, what in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(what)}$", ended.out, re.MULTILINE)


def test_every_command_is_in_one_group_and_has_examples() -> None:
    assert sorted(name for names in GROUPS.values() for name in names) == sorted(COMMANDS) == sorted(EXAMPLES)


@pytest.mark.parametrize("line", [line for lines in EXAMPLES.values() for line in lines])
def test_examples_can_be_parsed(line: str) -> None:
    program, command, *args = shlex.split(line)
    assert (program, line in EXAMPLES[command]) == ("psiamfcpp", True)
    function = getattr(
        importlib.import_module(f"psiamfcpp.cli.{'import_' if command == 'import' else command}"),
        "import_" if command == "import" else command,
    )
    _parse(command, function, _gathered(function, args))


def test_help_can_be_asked_for_in_three_ways(run: Run) -> None:
    assert run("help", "datasets").out == run("datasets", "-h").out == run("datasets", "--help").out


@pytest.mark.parametrize("flag", ["--version", "-V", "version"])
def test_version(run: Run, flag: str) -> None:
    ended = run(flag)
    assert (ended.code, ended.out) == (0, f"psiamfcpp {psiamfcpp.__version__}\n")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_options_kinds_and_examples(run: Run, command: str) -> None:
    ended = run(command, "--help")
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.startswith(f"usage: psiamfcpp {command} ")
    # what speaks a protocol on standard output has no JSON of its own
    assert REQUIRED.get(command, "--model" if command == "trax" else "--json") in ended.out
    assert "examples:\n  " + EXAMPLES[command][0] in ended.out
    described = ended.out.partition("\nexamples:")[0]
    assert not re.search(r"\{None|default:\s+None|^ +None\)", described, re.MULTILINE)
    module = importlib.import_module(f"psiamfcpp.cli.{command.replace('import', 'import_')}")
    function = getattr(module, command.replace("import", "import_"))
    # options, run and positionals are shown by their parts or by their type
    options = inspect.signature(function).parameters.keys() - {
        "options",
        "span",
        "overlay",
        "constants",
        "run",
        "source",
        "model",
        "checkpoint",
        "ranks",
    }
    assert options
    for option in options - ({"results"} if command == "report" else set()):
        assert re.search(rf"--{option.replace('_', '-')}\b", ended.out), option


@pytest.mark.parametrize(
    ("command", "output"),
    [
        (["demo"], "o.mp4"),
        (["plan", "no.json", "--preset", "paper"], "plan.json"),
        (["prune", "siamfcpp-alexnet", "--plan", "no.json"], "o.safetensors"),
        (["calibrate", "siamfcpp-alexnet", "--data", "no"], "o.safetensors"),
        (["import", "no.pkl"], "o.safetensors"),
        (["export", "no-such-model"], "folder"),
        (["report", "no"], "folder"),
    ],
)
def test_no_command_replaces_what_exists_unasked(run: Run, tmp_path: Path, command: list[str], output: str) -> None:
    path = tmp_path / output
    kept = path if path.suffix else path / "file"
    kept.parent.mkdir(exist_ok=True)
    kept.write_text("keep me")
    assert "or give --overwrite" in run(*command, "-o", path).refused()
    assert kept.read_text() == "keep me"
    # with leave, the next complaint is of something else, or of nothing
    if command != ["demo"]:
        assert "--overwrite" not in run(*command, "-o", path, "--overwrite").complaint()


@pytest.mark.parametrize(
    ("command", "hint"),
    [
        ("trak", "did you mean 'track'?"),
        ("evalute", "did you mean 'evaluate'?"),
        ("zzz", "commands are demo, track, info"),
        ("", "commands are demo"),
        ("--verbose", "unknown command '--verbose'"),
    ],
)
def test_an_unknown_command_is_answered_with_known_ones(run: Run, command: str, hint: str) -> None:
    complaint = run(command, "x").refused()
    assert f"unknown command {command!r}" in complaint
    assert hint in complaint


@pytest.mark.parametrize("command", COMMANDS)
def test_an_unknown_option_is_named(run: Run, command: str) -> None:
    assert run(command, "--no-such-option", "x").refused().startswith("unknown option --no-such-option: ")


@pytest.mark.parametrize(
    "args",
    [
        ["track", "clip.mp4", "--bxo", "1,2,3,4"],
        ["track", "--bxo", "1,2,3,4", "clip.mp4"],
        ["track", "--bxo=1,2,3,4", "clip.mp4", "--output", "out.mp4"],
    ],
)
def test_a_misspelt_option_is_blamed_wherever_it_stands(run: Run, args: list[str]) -> None:
    assert run(*args).refused() == "unknown option --bxo: did you mean --box?"


@pytest.mark.parametrize(("command", "what"), REQUIRED.items())
def test_what_is_missing_is_named(run: Run, command: str, what: str) -> None:
    assert what in run(command).refused()


@pytest.mark.parametrize(
    ("args", "part"),
    [
        (["track", "a.mp4", "--modle", "x", "--box", "1,2,3,4"], "--model"),
        (["track", "a.mp4", "--box"], "--box"),
        (["track", "a.mp4", "--box", "1,2,3,4", "--threads", "many"], "--threads"),
        (["demo", "--frames", "ten"], "--frames"),
        (["info", "a", "b"], "b"),
        (["evaluate", "--root", ".", "--dataset", "nothing"], "nothing"),
        (["score", "--dataset", "dtb7", "--annotations", ".", "--results", "."], "dtb7"),
    ],
)
def test_a_wrong_value_is_named(run: Run, args: list[str], part: str) -> None:
    assert part in run(*args).refused()


@pytest.mark.slow
def test_the_module_can_be_started_and_its_reader_may_leave() -> None:
    """As in `psiamfcpp track --help | head -1`; with Python's own buffer, which is written at the very end."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    command = [sys.executable, "-m", "psiamfcpp", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    assert done.stdout.startswith("psiamfcpp ")
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as closed:
        done = subprocess.run(command, stdout=closed, stderr=subprocess.PIPE, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_what_a_library_makes_of_an_interruption_is_an_interruption(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """torch-pruning gives a KeyboardInterrupt during its trace as an error of its own."""

    def interrupted(*_: object) -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise UserError("torch-pruning cannot trace the network") from None

    monkeypatch.setattr("psiamfcpp.cli.datasets.print_json", interrupted)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        ended = run("datasets", "--json")
    finally:
        signal.signal(signal.SIGINT, before)
    assert (ended.code, ended.out, ended.err) == (130, "", "psiamfcpp: interrupted\n")


@pytest.mark.parametrize("rule", ["\u2500", "-"])
def test_a_complaint_is_one_line_without_its_frame(rule: str) -> None:
    panel = f"{rule * 3} Parsing error {rule * 3}\n{rule * 40}\nunknown --a-b\n{rule * 40}\nrun --help\n"
    assert _one_line(panel) == "unknown --a-b run --help"
