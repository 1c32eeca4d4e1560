"""What is wrong with the launcher's machine: pure functions of a run's records, one a fault."""

from statistics import median

from rmc.analysis.bottleneck import busy_threads, free_cores, host_cores, threads_of_learner
from rmc.analysis.finding import Finding
from rmc.analysis.vitals import Vitals
from rmc.deploy.run.config import RunConfig

CROWDED = 1.15  # threads that are busy, for each core
IDLE_CORES = 0.1  # of all cores: where more are idle, nobody fights for them
LOADED = 1.3  # processes that could run, for each CPU of the machine
LITTLE_MEMORY = 0.05  # of all that is left
SWAPPED_BYTES = 64 << 20  # within the span
STOLEN = 0.1  # of the CPU time
SLOWED, COPIES = 0.33, 6  # of the best speed of a copy in the same start; copies that it takes to judge


def threads_fight(vitals: Vitals, config: RunConfig) -> Finding | None:
    """The run itself computes on more threads than there are cores."""
    cores = host_cores(vitals)
    if not cores:
        return None
    threads, busy = threads_of_learner(vitals, config, cores), busy_threads(vitals, config, cores)
    on_cores = f"on {cores} core{'s' * (cores > 1)}"
    if threads > cores:
        measured = f"the learner has {threads} threads {on_cores}"
        return Finding("threads fight", measured, f"--threads {max(1, cores - 1)} leaves one to the other roles")
    free = free_cores(vitals)
    if busy <= CROWDED * cores or free is None or free > IDLE_CORES * cores:
        return None
    measured = f"{busy:.1f} threads of the run are busy at a time, {on_cores}"
    fewer = max(1, int(cores - busy + threads))
    if fewer < threads:
        return Finding("threads fight", measured, f"--threads {fewer} in place of {threads} would fit")
    actors = max(1, int(config.actors - (busy - cores)))
    if actors < config.actors:
        return Finding("threads fight", measured, f"--actors {actors} with more --envs-per-actor would fit")
    return Finding(
        "threads fight", measured, "more cores, or another machine for the actors (--launcher ray), would help"
    )


def oversubscribed(vitals: Vitals, config: RunConfig) -> Finding | None:
    """Others compute on this machine, too."""
    load, cpus, cores = vitals.mean("launcher", "host_load"), vitals.last("launcher", "host_cpus"), host_cores(vitals)
    if load is None or not (cpus and cores) or load <= LOADED * cpus:
        return None
    busy = busy_threads(vitals, config, cores)
    if load <= busy + LOADED:  # it is this run's own, which threads_fight judges
        return None
    measured = f"load {load:.1f} on {cpus:.0f} CPUs, of which this run is {busy:.1f}"
    return Finding("oversubscribed", measured, "other programs take the rest: end them, or use another machine")


def stolen(vitals: Vitals, _: RunConfig) -> Finding | None:
    """A hypervisor gives the CPUs to other guests."""
    share = vitals.mean("launcher", "host_steal_share")
    if share is None or share < STOLEN:
        return None
    measured = f"the hypervisor gave {share:.0%} of the CPU time to others"
    return Finding("CPU stolen", measured, "another machine, or one with CPUs of its own, would help")


def slow_memory(vitals: Vitals, _: RunConfig) -> Finding | None:
    """The bandwidth of the memory is used up."""
    copied = vitals.values("launcher", "host_copy_bytes_per_s")
    if len(copied) < COPIES or median(copied) >= SLOWED * max(copied):
        return None
    measured = f"it was copied at {median(copied) / 1e9:.1f} GB/s, at best at {max(copied) / 1e9:.1f} GB/s"
    advice = (
        "roles and other programs take its bandwidth: fewer --actors or --threads here, or more machines, would help"
    )
    return Finding("memory is slow", measured, advice)


def little_memory(vitals: Vitals, config: RunConfig) -> Finding | None:
    """Memory is short, or the machine swaps."""
    free, total = vitals.values("launcher", "host_available_bytes"), vitals.last("launcher", "host_memory_bytes")
    swap = vitals.values("launcher", "host_swap_bytes")
    swapped = swap[-1] - swap[0] if swap else 0.0
    if not free or not total or (min(free) > LITTLE_MEMORY * total and swapped < SWAPPED_BYTES):
        return None
    measured = (
        f"{min(free) / 1e6:,.0f} of {total / 1e6:,.0f} MB were free, {max(0.0, swapped) / 1e6:,.0f} MB were swapped"
    )
    half = config.replay.capacity // 2
    return Finding("memory is short", measured, f"fewer --actors, or --capacity {half} in a new run, takes less")
