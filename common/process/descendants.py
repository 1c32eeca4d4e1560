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


def adopt_orphans() -> None:
    """From now on, what lies below this process stays below it, whichever process between them ends. Linux alone."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def end_children(spared: Collection[int] = ()) -> None:
    """Kill this process's children and what lies below them, but for the ``spared`` children."""
    deadline = time.monotonic() + END_SECONDS
    while strays := [child for child in psutil.Process().children() if child.pid not in spared]:
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
