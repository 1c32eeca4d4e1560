"""What the launcher's machine has left, cheap enough to be asked for with every record."""

import os
import resource
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from rmc.deploy.run.preflight import cores, existing_parent, free_memory

COPIED_BYTES, COPIES = 64 << 20, 3
SAMPLED_BYTES = 16 << 20  # copied for every record, in some milliseconds: more than the caches of a core hold


@dataclass(frozen=True)
class Machine:
    """What a machine has for a run."""

    cores: int
    free_memory_bytes: int
    free_disk_bytes: int
    handles: int  # of a process
    copied_bytes_per_s: float  # in memory, by one thread


def this_machine(folder: Path) -> Machine:
    """What there is now; the disk is the one that ``folder`` is or would be on."""
    handles, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    memory, disk = free_memory(), shutil.disk_usage(existing_parent(folder)).free
    return Machine(cores(), memory, disk, handles, _copied_bytes_per_s())


def _copied_bytes_per_s() -> float:
    """The fastest of a few copies that no cache holds."""
    source, target = np.ones(COPIED_BYTES, np.uint8), np.zeros(COPIED_BYTES, np.uint8)
    seconds = []
    for _ in range(COPIES):
        began = time.perf_counter()
        np.copyto(target, source)
        seconds.append(time.perf_counter() - began)
    return COPIED_BYTES / min(seconds)


class HostFigures:
    """What the launcher says of its machine in each of its records."""

    def __init__(self, folder: Path) -> None:
        """The disk is the one that ``folder`` is on."""
        self._folder = folder
        self._source, self._target = (np.full(SAMPLED_BYTES, value, np.uint8) for value in (1, 2))

    def take(self) -> dict[str, float]:
        """Flat; shares of CPU time are since the last call."""
        return _figures() | _disk(self._folder) | {"host_copy_bytes_per_s": self._copied_per_s()}

    def _copied_per_s(self) -> float:
        """By this thread's own CPU time, so that waiting for a CPU does not count: what is left is memory."""
        began = time.thread_time()
        np.copyto(self._target, self._source)
        return SAMPLED_BYTES / max(time.thread_time() - began, 1e-6)


def _disk(folder: Path) -> dict[str, float]:
    """What is left of it; nothing where the folder is gone, which others say."""
    try:
        disk = shutil.disk_usage(folder)
    except OSError:
        return {}
    return {"host_disk_free_bytes": disk.free, "host_disk_bytes": disk.total}


def _figures() -> dict[str, float]:
    """Load, memory and what is left of the CPUs."""
    memory, cpu = psutil.virtual_memory(), psutil.cpu_times_percent()
    return {
        "host_cores": cores(),
        "host_cpus": os.cpu_count() or 1,
        "host_load": psutil.getloadavg()[0],
        "host_idle_share": cpu.idle / 100.0,
        "host_memory_bytes": memory.total,
        "host_available_bytes": memory.available,
        "host_swap_bytes": psutil.swap_memory().used,
        "host_steal_share": getattr(cpu, "steal", 0.0) / 100.0,
    }
