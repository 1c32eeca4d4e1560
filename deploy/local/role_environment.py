"""How a role's process is started: its command line and its environment variables."""

import os
import subprocess
import sys
from collections.abc import Collection, Mapping, Sequence
from typing import BinaryIO

from rmc.common.process.parent_death import PARENT_VARIABLE

SINGLE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
SECRET_VARIABLE, URL_VARIABLE = "RMC_SECRET", "RMC_REDIS_URL"  # each for one role: what it starts does not inherit it


def command_line(words: Sequence[str]) -> list[str]:
    """A role's, in a process of its own; one that is forked bears it as its title."""
    return [sys.executable, "-P", "-m", "rmc.cli.main", *words]


def start_process(
    words: Sequence[str], log: BinaryIO, variables: Mapping[str, str], pass_fds: Collection[int] = ()
) -> subprocess.Popen[bytes]:
    """One that ends with this one, in a group of its own: Ctrl-C is for the supervisor alone. Raises OSError.

    Beside ``variables`` it has this one's as they were before an environment was made, but no secret, whoever set it.
    """
    from rmc.common.env.process_state import our_variables  # numpy, without which `rmc --version` does

    inherited = {name: value for name, value in our_variables().items() if name not in (SECRET_VARIABLE, URL_VARIABLE)}
    environment = {**inherited, **variables, PARENT_VARIABLE: str(os.getpid())}
    return subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment, process_group=0, pass_fds=pass_fds,
        cwd=working_folder(),
    )  # fmt: skip


def working_folder() -> str:
    """Where a role's process starts: here, or at the root where this folder was deleted, in which MKL is not loaded."""
    try:
        return os.getcwd()
    except FileNotFoundError:
        return "/"
