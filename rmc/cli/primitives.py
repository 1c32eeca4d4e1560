"""Words as people write them: 1000000, 1_000_000 and 1e6 are the same whole number, ``~`` in a path is their home."""

from contextlib import suppress
from pathlib import Path

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from rmc.common.user_path import user_path

PRIMITIVES = ConstructorRegistry()


@PRIMITIVES.primitive_rule
def _whole_numbers(kind: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[int] | None:
    if kind.type is not int:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda words: read_whole(words[0]),
        is_instance=lambda value: type(value) is int,
        str_from_instance=lambda value: [str(value)],
    )


@PRIMITIVES.primitive_rule
def _paths(kind: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Path] | None:
    if kind.type is not Path:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: user_path(words[0]),
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda value: [str(value)],
    )


def read_whole(word: str) -> int:
    """A whole number. Raises ValueError."""
    for read in (int, float):
        with suppress(ValueError, OverflowError):
            if (number := read(word)) == int(number):
                return int(number)
    raise ValueError(f"{word!r} is no whole number")
