"""What a run will need beside what the machine has, from a trial of some seconds: pure functions of both."""

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

from rich.filesize import decimal as size_text

from rmc.analysis.bottleneck import busy_threads, threads_of_learner
from rmc.analysis.host_faults import CROWDED
from rmc.analysis.vitals import Vitals
from rmc.common.errors import ConfigError
from rmc.deploy.local.trial import RoleUse, Trial
from rmc.deploy.monitor.figures import duration
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.host import Machine
from rmc.deploy.run.preflight import DISK_RESERVE, ring_bytes

KEPT_BESIDE = 2  # checkpoints beside the newest: the best, and the one that is being written
WIRE_SHARE = 0.2  # of the speed at which memory is copied: on its way a window is copied and checked some times


@dataclass(frozen=True)
class Need:
    """A row of ``rmc train --dry-run``."""

    what: str
    needs: str
    has: str = ""
    fits: bool | None = None  # None where it is only told
    is_needed: bool = True  # else what does not fit is only slower


@dataclass(frozen=True)
class There:
    """What a run that goes on has already."""

    ring_bytes: int = 0
    checkpoint_bytes: int = 0
    env_steps: int = 0


@dataclass(frozen=True)
class Speed:
    """How fast a run goes once it is warm."""

    steps_per_s: float
    updates_per_s: float
    windows_per_s: float


def speed(config: RunConfig, records: list[dict[str, Any]]) -> Speed:
    """By what the learner draws: over a whole run the replay ratio holds, in its first seconds it need not.

    Raises ConfigError where the trial was too short to say.
    """
    vitals = Vitals(records).training()
    drawn = sum(_slope(vitals, role, "drawn_steps") for role in vitals.of("replay"))
    if drawn <= 0.0:
        fix = "a trial of it is over too soon to be measured; train it"
        raise ConfigError("--total-steps", config.total_steps, fix)
    steps_per_s = drawn / config.replay.replay_ratio
    windows, steps = (sum(vitals.last(role, name) for role in vitals.of("replay")) for name in ("windows", "env_steps"))
    return Speed(steps_per_s, _slope(vitals, "learner", "updates"), steps_per_s * windows / steps)


def _slope(vitals: Vitals, role: str, name: str) -> float:
    series = vitals.series(role, name)
    if len(series) < 2:
        return 0.0
    (began, before), (ended, after) = series[0], series[-1]
    return (after - before) / max(ended - began, 1e-9)


def needs(config: RunConfig, trial: Trial, machine: Machine, there: There = There()) -> list[Need]:
    """All rows, in the order in which they are shown."""
    fast = speed(config, trial.records)
    seconds = max(0, config.total_steps - there.env_steps) / fast.steps_per_s
    at = f"{fast.steps_per_s:,.0f} steps/s, {fast.updates_per_s:,.1f} updates/s"
    return [
        *memory(config, trial.roles, machine),
        *disk(config, trial, seconds, machine, there),
        *bandwidth(config, fast, machine),
        *handles(trial.roles, machine),
        threads(config, trial.records, machine),
        Need("time to the end", f"{duration(seconds)} at {at}"),
    ]


def memory(config: RunConfig, roles: dict[str, RoleUse], machine: Machine) -> list[Need]:
    """Of each role, of the ring's pages, and of all."""
    uses: dict[str, list[int]] = defaultdict(list)
    for role, use in sorted(roles.items()):
        uses[role.partition("-")[0]].append(use.memory_bytes)
    pages, total = ring_bytes(config), sum(map(sum, uses.values()))
    rows = [_role_memory(kind, each) for kind, each in uses.items()]
    rows.append(Need("memory, pages of the ring", size_text(pages)))
    fits = total + pages <= machine.free_memory_bytes
    return [*rows, Need("memory, all", size_text(total + pages), f"{size_text(machine.free_memory_bytes)} free", fits)]


def _role_memory(kind: str, each: list[int]) -> Need:
    count = f" ({len(each)})" if len(each) > 1 else ""
    return Need(f"memory, {kind}{count}", size_text(sum(each)))


def disk(config: RunConfig, trial: Trial, seconds: float, machine: Machine, there: There) -> list[Need]:
    """What is to come of the ring, the checkpoints, what is recorded until the end, and all."""
    rows, kept = max(0, ring_bytes(config) - there.ring_bytes), config.learner.keep_checkpoints + KEPT_BESIDE
    count = config.total_steps // config.learner.checkpoint_steps + 1
    saved = max(0, min(kept, count) * trial.checkpoint_bytes - there.checkpoint_bytes)
    records = int(trial.record_bytes_per_s * seconds)
    free = max(0, machine.free_disk_bytes - DISK_RESERVE)
    return [
        Need("disk, ring", size_text(rows)),
        Need(f"disk, {min(kept, count)} checkpoints", size_text(saved)),
        Need("disk, metrics", size_text(records)),
        Need("disk, all", size_text(rows + saved + records), f"{size_text(free)} free", rows + saved + records <= free),
    ]


def bandwidth(config: RunConfig, fast: Speed, machine: Machine) -> list[Need]:
    """To and from the replay servers, beside a share of what this machine copies in memory."""
    row, has = config.window_spec().dtype.itemsize, int(WIRE_SHARE * machine.copied_bytes_per_s)
    flows = {"to": fast.windows_per_s * row, "from": fast.updates_per_s * config.learner.batch_size * row}
    return [
        Need(f"bandwidth {way} replay", f"{size_text(int(flow))}/s", f"{size_text(has)}/s", flow <= has, False)
        for way, flow in flows.items()
    ]


def handles(roles: dict[str, RoleUse], machine: Machine) -> list[Need]:
    """Of the process that has the most: the limit is a process's."""
    rows = []
    for what in ("handles", "sockets"):
        role, most = max(((role, getattr(use, what)) for role, use in roles.items()), key=lambda one: one[1])
        title = "file handles" if what == "handles" else what
        rows.append(Need(f"{title} of a role", f"{most} ({role})", f"{machine.handles}", most <= machine.handles))
    return rows


def threads(config: RunConfig, records: list[dict[str, Any]], machine: Machine) -> Need:
    """The learner's and one of every other role, and how many of them work at a time."""
    vitals, others = Vitals(records).training(), len(config.roles()) - 1
    learner = threads_of_learner(vitals, config, machine.cores)
    busy = busy_threads(vitals, config, machine.cores)
    text = f"{learner} learner + {others} others, {busy:.1f} busy"
    return Need("threads", text, f"{machine.cores} cores", max(learner, busy) <= CROWDED * machine.cores, False)
