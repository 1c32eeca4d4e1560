"""Functions compiled by numba, their machine code kept beside the source where that can be written."""

from collections.abc import Callable, Set
from pathlib import Path
from typing import TypeVar, cast

import numba

FunctionT = TypeVar("FunctionT", bound=Callable[..., object])


def compiled(function: FunctionT, fastmath: Set[str] = frozenset()) -> FunctionT:
    """The same function in machine code. ``fastmath``: liberties that LLVM may take with floating point."""
    liberties = set(fastmath) or False
    try:
        Path.home()  # raises without one, where numba would make a folder called ~
        return cast(FunctionT, numba.njit(function, cache=True, fastmath=liberties, error_model="numpy", nogil=True))
    except RuntimeError:  # nowhere to keep it: compile at every start
        return cast(FunctionT, numba.njit(function, fastmath=liberties, error_model="numpy", nogil=True))
