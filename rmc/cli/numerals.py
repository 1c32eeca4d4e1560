"""Whole numbers as people write them: 1000000, 1_000_000 and 1e6 are the same."""

from contextlib import suppress

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

NUMERALS = ConstructorRegistry()


@NUMERALS.primitive_rule
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


def read_whole(word: str) -> int:
    """A whole number. Raises ValueError."""
    for read in (int, float):
        with suppress(ValueError, OverflowError):
            if (number := read(word)) == int(number):
                return int(number)
    raise ValueError(f"{word!r} is no whole number")
