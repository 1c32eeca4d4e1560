"""What the launcher's machine has left, cheap enough to be asked for with every record."""

import os

import psutil

from rmc.deploy.run.preflight import cores


def host_figures() -> dict[str, float]:
    """Load, memory and what is left of the CPUs, flat; shares of their time are since the last call."""
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
