"""Calls that fail."""

from collections.abc import Callable
from typing import NoReturn


def raising(error: BaseException) -> Callable[..., NoReturn]:
    """What a function is replaced by that raises this, whatever it is called with."""

    def call(*_: object, **__: object) -> NoReturn:
        raise error

    return call
