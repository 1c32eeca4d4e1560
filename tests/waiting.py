"""Waiting for what another process or thread is about to do."""

import re
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress

import psutil


def wait_until(
    condition: Callable[[], object], seconds: float = 30.0, said: Callable[[], object] = str, pause: float = 0.02
) -> None:
    """Look again and again until it holds; fails after so many seconds, with what was ``said``."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, said()
        time.sleep(pause)


def matching(pattern: str, among: Iterable[psutil.Process]) -> Iterator[psutil.Process]:
    """Those whose command line the regular expression is found in; one that ends meanwhile is none."""
    for process in among:
        with suppress(psutil.Error):
            if re.search(pattern, " ".join(process.cmdline())):
                yield process


def alive(processes: list[psutil.Process]) -> list[psutil.Process]:
    """Those that still run."""
    return [process for process in processes if process.is_running() and process.status() != psutil.STATUS_ZOMBIE]
