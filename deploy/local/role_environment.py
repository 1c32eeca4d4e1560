"""What a role's process is started with: its command line and its environment variables."""

import os
import sys
from collections.abc import Sequence

SINGLE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
SECRET_VARIABLE, URL_VARIABLE = "RMC_SECRET", "RMC_REDIS_URL"  # each for one role: what it starts does not inherit it


def command_line(words: Sequence[str]) -> list[str]:
    """A role's, in a process of its own; one that is forked bears it as its title."""
    return [sys.executable, "-P", "-m", "rmc.cli.main", *words]


def inherited() -> dict[str, str]:
    """What a role's process has of this one's environment: no secret, whoever set it here."""
    return {name: value for name, value in os.environ.items() if name not in (SECRET_VARIABLE, URL_VARIABLE)}


def working_folder() -> str:
    """Where a role's process starts: here, or at the root where this folder was deleted, in which MKL is not loaded."""
    try:
        return os.getcwd()
    except FileNotFoundError:
        return "/"
