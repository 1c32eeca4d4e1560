"""Processes of this machine: found by their words, and whether they run."""

import re
from collections.abc import Iterable, Iterator
from contextlib import suppress

import psutil


def matching(pattern: str, among: Iterable[psutil.Process]) -> Iterator[psutil.Process]:
    """Those whose command line the regular expression is found in; one that ends meanwhile is none."""
    for process in among:
        with suppress(psutil.Error):
            if re.search(pattern, " ".join(process.cmdline())):
                yield process


def alive(processes: list[psutil.Process]) -> list[psutil.Process]:
    """Those that still run."""
    return [process for process in processes if process.is_running() and process.status() != psutil.STATUS_ZOMBIE]
