"""Processes that an environment starts: they end with its role, also where they have left its process group."""

import ctypes
import os
import sys
import time
from collections.abc import Collection
from contextlib import suppress

import psutil

PR_SET_CHILD_SUBREAPER = 36
END_SECONDS = 1.5
LOOK_SECONDS = 0.01
_SPARED: set[int] = set()


def adopt_orphans() -> None:
    """From now on, what lies below this process stays below it, whichever process between them ends. Linux alone."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def spare_children() -> None:
    """From now on, the children of now are not ours to end: of a shell that has become this process, or Ray's own."""
    _SPARED.clear()
    _SPARED.update(child.pid for child in psutil.Process().children())


def end_children(roles: Collection[int] = ()) -> None:
    """Kill this process's children and what lies below them, but for the ``roles`` and what ``spare_children`` saw."""
    deadline = time.monotonic() + END_SECONDS
    while strays := [child for child in psutil.Process().children() if child.pid not in _SPARED.union(roles)]:
        for child in strays:
            end(child)
            with suppress(ChildProcessError):
                os.waitpid(child.pid, os.WNOHANG)
        if time.monotonic() >= deadline:  # one that the kernel holds
            return
        time.sleep(LOOK_SECONDS)


def end(child: psutil.Process) -> None:
    """Kill a process and what lies below it."""
    with suppress(psutil.NoSuchProcess, psutil.AccessDenied):
        below = child.children(recursive=True)
        child.kill()
        for process in below:
            with suppress(psutil.NoSuchProcess, psutil.AccessDenied):
                process.kill()
