"""What a run takes of a machine, and so how many fit."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from rich.filesize import decimal as size_text

from rmc.common.errors import ConfigError
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.host import cores, existing_parent, free_memory
from rmc.deploy.run.preflight import DISK_RESERVE, ring_bytes
from rmc.sweep.job import Job

PROCESS_BYTES = 400 << 20  # of one with torch and MuJoCo; measured in docs/performance.md: 203 to 498 MB


def run_cores(config: RunConfig, lockstep: bool) -> int:
    """The learner's threads, which the first actor shares, and a core for each other actor."""
    return max(1, config.learner.threads) + (0 if lockstep else config.actors - 1)


def run_memory(config: RunConfig, lockstep: bool) -> int:
    """Bytes of a run's processes and its ring."""
    processes = 1 if lockstep else 1 + len(config.roles())
    return processes * PROCESS_BYTES + ring_bytes(config)


def runs_that_fit(run_cores: int, memory: int) -> int:
    """How many runs this machine's cores and free memory hold, at least one."""
    return max(1, min(cores() // run_cores, free_memory() // memory))


def evenly(runs: int, fit: int) -> int:
    """How many at once of so many, where ``fit`` fit: the last ones are as many, and each has more of the cores."""
    rounds = -(-runs // fit)
    return -(-runs // rounds)


def check_disk(folder: Path, jobs: Sequence[Job], ring: int, at_once: int, dropped: bool) -> None:
    """Raises ConfigError where the rings of runs that have none yet are larger than the free disk."""
    new = sum(not RunFolder(job.folder).rings() for job in jobs)
    count = min(new, at_once) if dropped else new
    free = shutil.disk_usage(existing_parent(folder.absolute())).free - DISK_RESERVE
    if count * ring > max(0, free):
        fix = f"{count} rings take {size_text(count * ring)}, {size_text(max(0, free))} are free; "
        way = "take fewer --jobs or a smaller capacity" if dropped else "take --drop-replay, or a smaller capacity"
        raise ConfigError("--sweep-dir", str(folder), fix + way)
