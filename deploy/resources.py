"""Whether the ring fits, asked before anything starts."""

import shutil
from pathlib import Path

import psutil

from common.errors import ConfigError
from common.window import WindowSpec

DISK_RESERVE = 256 << 20  # bytes left for checkpoints, metrics and logs


def check_ring_fits(spec: WindowSpec, capacity: int, folder: Path) -> None:
    """Raises ConfigError where the ring is larger than the free disk or the machine's memory.

    The ring is a mapped file; one larger than the memory would turn every draw into disk reads.
    """
    size = spec.dtype.itemsize * capacity
    ring = folder / "ring"
    existing = ring.stat().st_size if ring.exists() else 0
    there = next(path for path in (folder, *folder.parents) if path.exists())
    free_disk = max(0, shutil.disk_usage(there).free - DISK_RESERVE)
    if size - existing > free_disk:
        fits = (free_disk + existing) // spec.dtype.itemsize
        raise ConfigError(
            "--capacity", capacity, f"takes {_gb(size)} of disk, {_gb(free_disk)} are free; take at most {fits}"
        )
    memory = psutil.virtual_memory().total
    if size > memory:
        fits = memory // spec.dtype.itemsize
        raise ConfigError("--capacity", capacity, f"takes {_gb(size)} of {_gb(memory)} memory; take at most {fits}")


def _gb(size: int) -> str:
    return f"{size / 1e9:.1f} GB"
