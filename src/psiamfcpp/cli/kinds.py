"""How values that may be left out are read: as their own kind, and not as a union with None."""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any, Union, get_args, get_origin

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

# What help shows for each kind, and what errors call it.
_KINDS: dict[type, tuple[str, str]] = {
    str: ("STR", "a text"),
    int: ("INT", "a whole number"),
    float: ("FLOAT", "a number"),
    Path: ("PATH", "a path"),
}
KINDS = ConstructorRegistry()


@KINDS.primitive_rule
def _or_nothing(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Return how ``kind | None`` is read; None for every other type, which tyro reads itself."""
    arms = get_args(info.type)
    kinds = [arm for arm in arms if arm is not type(None)]
    union = get_origin(info.type) in (types.UnionType, Union) and len(arms) == 2
    if not union or len(kinds) != 1 or kinds[0] not in _KINDS:
        return None
    kind = kinds[0]
    shown, called = _KINDS[kind]

    def read(words: list[str]) -> Any:
        try:
            return kind(words[0])
        except ValueError:
            raise ValueError(f"{words[0]!r} is not {called}") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=shown,
        instance_from_str=read,
        is_instance=lambda value: value is None or isinstance(value, kind),
        str_from_instance=lambda value: [str(value)],
    )
