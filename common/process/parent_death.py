"""Processes that die with their parent, so that nothing outlives a supervisor, even one killed by force.

Run as a script it ties itself to its parent and becomes another program:
``python parent_death.py PARENT_PID PROGRAM ARGUMENTS…``. It imports nothing but the standard library.
"""

import ctypes
import os
import signal
import sys
import threading
import time

PARENT_VARIABLE = "RMC_PARENT"  # tells a role the process that it must not outlive
PR_SET_PDEATHSIG = 1
POLL_SECONDS = 1.0


def exit_with_parent(parent: int) -> None:
    """From now on, end when process ``parent`` ends.

    SIGKILL on purpose: ring and checkpoints survive it, and a role stuck in a call ends, too. Where the kernel
    cannot do it (macOS) a thread watches; that one does not survive an exec.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    else:
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    if os.getppid() != parent:  # it died before the line above
        os._exit(1)


def outlive_parent() -> None:
    """From now on, this process notices its parent's end itself, and has something to do then."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, 0)


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(POLL_SECONDS)
    os._exit(1)


if __name__ == "__main__":
    exit_with_parent(int(sys.argv[1]))
    os.execv(sys.argv[2], sys.argv[2:])
