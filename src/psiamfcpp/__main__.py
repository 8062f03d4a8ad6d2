"""`psiamfcpp`, and `python -m psiamfcpp`, which is also how `torchrun` starts a command."""

from __future__ import annotations

import sys

from psiamfcpp.signals import ended_like_ctrl_c, ignore_signals


def run() -> int:
    """Run the command line; signals end it in one line from its first import to its last file."""
    try:
        with ended_like_ctrl_c():
            from psiamfcpp.cli import main
    except KeyboardInterrupt:
        print("psiamfcpp: interrupted", file=sys.stderr)
        return 130
    code = main()
    # what is left to do, the end of libraries, cannot be interrupted in a clean way
    ignore_signals()
    return code


if __name__ == "__main__":
    sys.exit(run())
