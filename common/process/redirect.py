"""Where this process prints, for a while."""

import ctypes
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


@contextmanager
def redirected(places: Mapping[int, int]) -> Iterator[None]:
    """What is printed, by C code, too, goes to other file descriptors: to the value of each key."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = {number: os.dup(number) for number in places}
    for number, place in places.items():
        os.dup2(place, number)
    try:
        yield
    finally:
        sys.stdout.flush()
        ctypes.CDLL(None).fflush(None)  # or it is printed later
        for number, copy in kept.items():
            os.dup2(copy, number)
            os.close(copy)
