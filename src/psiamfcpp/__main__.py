"""`python -m psiamfcpp`, which is also how `torchrun` starts a command."""

import sys

from psiamfcpp.cli import main

if __name__ == "__main__":
    sys.exit(main())
