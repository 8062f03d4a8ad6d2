"""Arguments that several commands share, each described once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

Model = Annotated[
    str, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL", help="name of a shipped model, or a model file")
]
SourceName = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
HeldOut = Annotated[
    int,
    tyro.conf.arg(help="hold out one clip in N of the data, the same N as in `psiamfcpp train`; 0 holds out none"),
]
Overwrite = Annotated[bool, tyro.conf.arg(help="replace files that exist already")]
SkipBad = Annotated[
    bool,
    tyro.conf.arg(help="leave out rows, images and sequences that cannot be read, instead of refusing the data"),
]
Json = Annotated[bool, tyro.conf.arg(help="print one JSON object")]
