"""Words as people write them: 1000000, 1_000_000 and 1e6 are the same whole number, ``~`` in a path is their home."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from rmc.common.user_path import user_path

PRIMITIVES = ConstructorRegistry()


def read_whole(word: str) -> int:
    """A whole number. Raises ValueError."""
    for read in (int, float):
        with suppress(ValueError, OverflowError):
            if (number := read(word)) == int(number):
                return int(number)
    raise ValueError(f"{word!r} is no whole number")


@PRIMITIVES.primitive_rule
def _read(kind: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    if kind.type is not int and kind.type is not Path:
        return None
    read: Callable[[str], Any] = read_whole if kind.type is int else user_path
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.type.__name__.upper(),
        instance_from_str=lambda words: read(words[0]),
        is_instance=lambda value: isinstance(value, kind.type) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )
