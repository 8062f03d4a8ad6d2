"""The command line: one typed function a command, in the module of the command's name."""

from __future__ import annotations

import contextlib
import difflib
import functools
import importlib
import io
import os
import re
import sys
from collections.abc import Callable
from typing import Any, get_origin, get_type_hints

import tyro

from psiamfcpp.cli.examples import GROUPS, examples
from psiamfcpp.errors import UserError
from psiamfcpp.files import printable
from psiamfcpp.signals import ended_like_ctrl_c
from psiamfcpp.version import __version__

COMMANDS = {
    "demo": "render an aerial clip, follow its target, and say how well",
    "track": "follow a target in a video, camera, stream or image folder",
    "info": "describe a model: widths, parameters, MACs, constants, provenance",
    "serve": "follow targets for a browser, for programs and for a ground station",
    "evaluate": "run a tracker over a benchmark, or a folder of sequences, and score it",
    "score": "score boxes that trackers left behind, without the frames",
    "report": "set trackers side by side on one page, with tables, plots and frames",
    "reproduce": "run the paper's tables and figures, with ours beside every published cell",
    "trax": "serve a tracker to vot-toolkit, or any other TraX client",
    "trackers": "list the trackers, and what is missing for each",
    "datasets": "list the benchmarks, where to get them, and what of them is there",
    "train": "train a network, or fine-tune one",
    "rank": "average rank of each filter's map, as a table to plan pruning with",
    "plan": "choose the filters to keep: shares, thresholds, the paper's, or a budget",
    "prune": "cut a model down to the filters that a plan keeps",
    "sensitivity": "what pruning each layer costs, and what other criteria are worth",
    "calibrate": "fit the confidence that separates tracking, unsure and lost",
    "bench": "time models, engines and peers in turn, and say where the time goes",
    "export": "write the graphs that run a model without torch, checked against it",
    "import": "convert an official SiamFC++ checkpoint or LightFC's graphs",
}

# What only an extra installs, and which.
_OPTIONAL = {
    "jinja2": "report",
    "matplotlib": "report",
    "onnx": "train",
    "safetensors": "train",
    "torch": "train",
    "torch_pruning": "train",
    "fastapi": "serve",
    "starlette": "serve",
    "uvicorn": "serve",
    "websockets": "serve",
    "pymavlink": "mavlink",
    "serial": "mavlink",
}


def main(args: list[str] | None = None) -> int:
    """Run a command.

    Args:
        args: command and options; those of the process by default.

    Returns:
        The exit code: 0, or 2 after a one-line error on standard error, or 130 after an interruption.
    """
    args = sys.argv[1:] if args is None else args
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a result must not be lost for a name that the terminal cannot show
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        if args[0:1] == ["help"] and args[1:]:
            args = [args[1], "--help"]
        if not args or args[0] in ("-h", "--help", "help"):
            print(_overview())
        elif args[0] in ("-V", "--version", "version"):
            print(f"psiamfcpp {__version__}")
        else:
            _run_until_signal(args[0], args[1:])
        # Now, not at exit, where a reader that has left would look like a fault.
        sys.stdout.flush()
        return 0
    except UserError as error:
        print(f"psiamfcpp: {printable(' '.join(str(error).split()))}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        extra = _OPTIONAL.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        print(f"psiamfcpp: this needs {error.name}: pip install 'psiamfcpp[{extra}]'", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("psiamfcpp: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output has left, as `head` does; nothing is wrong, but Python would complain at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        # a file that the system refuses, as one of 500 characters or of another user, wherever it was met
        if error.filename is None:
            raise
        name = os.fsdecode(error.filename) if isinstance(error.filename, (str, bytes)) else error.filename
        print(f"psiamfcpp: {printable(name)} cannot be used ({error.strerror}): choose another", file=sys.stderr)
        return 2


def _run_until_signal(command: str, args: list[str]) -> None:
    with ended_like_ctrl_c() as ending:
        try:
            _run(command, args)
        except BaseException:
            # some libraries make an error of their own of the interruption
            if ending.asked:
                raise KeyboardInterrupt from None
            raise


def _run(command: str, args: list[str]) -> None:
    if command not in COMMANDS:
        near = difflib.get_close_matches(command, COMMANDS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"commands are {', '.join(COMMANDS)}"
        raise UserError(f"unknown command {command!r}: {hint}")
    # A module may not be called import.
    module = importlib.import_module(f"psiamfcpp.cli.{'import_' if command == 'import' else command}")
    function = module.import_ if command == "import" else getattr(module, command)
    args = _gathered(function, args)
    complaint, shown = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint), contextlib.redirect_stdout(shown):
            call = _parse(command, function, args)
    except SystemExit as stop:
        if not stop.code:
            print(_tidy(shown.getvalue()) + examples(command))
            return
        raise UserError(_misspelt(command, function, args) or _one_line(complaint.getvalue())) from None
    call()


def _parse(command: str, function: Callable[..., None], args: list[str]) -> Callable[[], None]:
    from psiamfcpp.cli.kinds import KINDS

    return tyro.cli(
        _deferred(function),
        prog=f"psiamfcpp {command}",
        args=args,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
        registry=KINDS,
    )


def _gathered(function: Callable[..., None], args: list[str]) -> list[str]:
    """`--tracker A --tracker B` as `--tracker A B`: of an option of several values, tyro would keep the last alone."""
    # those that tyro appends, and positional ones, are annotated
    hints = get_type_hints(function, include_extras=True)
    several = {f"--{name.replace('_', '-')}" for name, hint in hints.items() if get_origin(hint) in (list, tuple)}
    group: list[str] = []
    groups = [group]
    for arg in args:
        name, sign, value = arg.partition("=")
        option = name.replace("_", "-")
        if option in several:
            if not (earlier := [known for known in groups if known[:1] == [option]]):
                groups += (earlier := [[option]])
            group = earlier[0]
            group += [value] if sign else []
        elif re.match("--?[a-z]", arg):
            groups.append(group := [arg])
        else:
            group.append(arg)
    return [arg for group in groups for arg in group]


def _misspelt(command: str, function: Callable[..., None], args: list[str]) -> str | None:
    """A complaint about the first option that the command lacks: tyro takes some for values, and blames another."""
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
        _parse(command, function, ["--help"])
    known = set(re.findall(r"(?<![\w-])--[a-z][\w-]*", shown.getvalue()))
    for arg in args:
        option = arg.partition("=")[0].replace("_", "-")
        if option.startswith("--") and option != "--" and option not in known:
            near = difflib.get_close_matches(option, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"`psiamfcpp {command} --help` lists its options"
            return f"unknown option {option}: {hint}"
    return None


def _deferred(function: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """The same signature, but returning the call instead of making it: parsing and running fail differently."""

    @functools.wraps(function)
    def prepare(*args: Any, **kwargs: Any) -> Callable[[], None]:
        return functools.partial(function, *args, **kwargs)

    return prepare


def _one_line(panel: str) -> str:
    """Return tyro's framed complaint as one line, without the help that it repeats."""
    panel = panel.partition("Argument helptext:")[0]
    # the frame is of hyphens where the terminal shows no other character
    lines = [re.sub(r"[\u2500-\u257f]|^-+$", " ", line.strip()).strip() for line in panel.splitlines()]
    return " ".join(line for line in lines[1:] if line)


def _tidy(shown: str) -> str:
    """Return tyro's help without defaults of None, and without the blanks that it ends lines with."""
    blanked = re.sub(r" ?\(default:\s+None\)", lambda match: re.sub(r"\S", " ", match[0]), shown)
    pairs = zip(shown.splitlines(), blanked.splitlines(), strict=True)
    # a line of which nothing is left but was something goes
    text = "\n".join(after.rstrip() for before, after in pairs if after.strip() or not before.strip())
    return text.replace("{None,", "{").replace(" options options", " tracker options") + "\n"


def _overview() -> str:
    rows = "\n\n".join(
        "\n".join([f"{group}:", *(f"  {name:11}  {COMMANDS[name]}" for name in names)])
        for group, names in GROUPS.items()
    )
    return f"usage: psiamfcpp COMMAND [OPTIONS]\n\n{rows}\n\n`psiamfcpp COMMAND --help` lists a command's options."
