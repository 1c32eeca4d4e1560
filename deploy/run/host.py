"""What this machine, or the container that this is in, has and has left."""

import os
import resource
import shutil
import time
from contextlib import suppress
from dataclasses import dataclass
from math import ceil
from pathlib import Path

import numpy as np
import psutil
from numpy.typing import NDArray

CONTAINER_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
CONTAINER_USE = (  # what it holds, what that is, and which of it is of files alone
    (Path("/sys/fs/cgroup/memory.current"), Path("/sys/fs/cgroup/memory.stat"), "inactive_file"),
    (
        Path("/sys/fs/cgroup/memory/memory.usage_in_bytes"),
        Path("/sys/fs/cgroup/memory/memory.stat"),
        "total_inactive_file",
    ),
)
CPU_LIMITS = (  # of CPU time in a period of it
    (Path("/sys/fs/cgroup/cpu.max"),),
    (Path("/sys/fs/cgroup/cpu/cpu.cfs_quota_us"), Path("/sys/fs/cgroup/cpu/cpu.cfs_period_us")),
)
COPIED_BYTES, COPIES = 64 << 20, 3  # to know a machine by; the first copy meets pages that are not there yet
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
    source, target = np.ones(COPIED_BYTES, np.uint8), np.zeros(COPIED_BYTES, np.uint8)
    return Machine(cores(), memory, disk, handles, max(_copied_per_s(source, target) for _ in range(COPIES)))


def free_memory() -> int:
    """Bytes that are free, no more than are left of a container's."""
    memory, limit = psutil.virtual_memory(), memory_limit()
    left = limit - _container_use() if limit < memory.total else limit
    return max(0, min(left, int(memory.available)))


def _container_use() -> int:
    """Bytes that this container holds, but for what it has read of files; 0 where nothing counts them."""
    for use, counts, files in CONTAINER_USE:
        with suppress(OSError, ValueError, KeyError):
            return int(use.read_text()) - int(dict(line.split() for line in counts.read_text().splitlines())[files])
    return 0


def memory_limit() -> int:
    """Bytes of the machine, or of the container that this is in."""
    memory = int(psutil.virtual_memory().total)
    for path in CONTAINER_LIMITS:
        with suppress(OSError, ValueError):  # no such version of cgroups, or "max"
            memory = min(memory, int(path.read_text()))
    return memory


def existing_parent(path: Path) -> Path:
    """The folder itself, or the nearest above it that is there."""
    return next(one for one in (path, *path.parents) if one.exists())


def cores() -> int:
    """Cores that this process may use, at most those of a container's CPU time. On macOS all that there are."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for files in CPU_LIMITS:
        with suppress(OSError, ValueError):  # no such version of cgroups, or "max"
            quota, period = map(int, " ".join(path.read_text() for path in files).split())
            count = min(count, ceil(quota / period)) if quota > 0 else count
    return count


def _copied_per_s(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> float:
    """By this thread's own CPU time, so that waiting for a CPU does not count: what is left is memory."""
    began = time.thread_time()
    np.copyto(target, source)
    return source.nbytes / max(time.thread_time() - began, 1e-6)


class HostFigures:
    """What the launcher says of its machine in each of its records."""

    def __init__(self, folder: Path) -> None:
        """The disk is the one that ``folder`` is on."""
        self._folder = folder
        self._source, self._target = (np.full(SAMPLED_BYTES, value, np.uint8) for value in (1, 2))

    def take(self) -> dict[str, float]:
        """Flat; shares of CPU time are since the last call."""
        copied = _copied_per_s(self._source, self._target)
        return _figures() | _disk(self._folder) | {"host_copy_bytes_per_s": copied}


def _disk(folder: Path) -> dict[str, float]:
    """What is left of it; nothing where the folder is gone, which others say."""
    try:
        disk = shutil.disk_usage(folder)
    except OSError:
        return {}
    return {"host_disk_free_bytes": disk.free, "host_disk_bytes": disk.total}


def _figures() -> dict[str, float]:
    """Load, memory and what is left of the CPUs."""
    cpu = psutil.cpu_times_percent()
    return {
        "host_cores": cores(),
        "host_cpus": os.cpu_count() or 1,
        "host_load": psutil.getloadavg()[0],
        "host_idle_share": cpu.idle / 100.0,
        "host_memory_bytes": memory_limit(),
        "host_available_bytes": free_memory(),
        "host_swap_bytes": psutil.swap_memory().used,
        "host_steal_share": getattr(cpu, "steal", 0.0) / 100.0,
    }
