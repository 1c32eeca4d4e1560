"""A few seconds of a run in a temporary folder, measured: what each role takes and how fast it goes."""

import dataclasses
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import ConfigError
from rmc.common.process.role import StopSignal
from rmc.deploy.local.launcher import TICK_SECONDS, LocalRun
from rmc.deploy.monitor.monitor import Monitor
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import make, open_run
from rmc.learner.config import MODEL_PROCESS

TRAINED_SECONDS = 10.0  # of updates, which are measured
LONGEST_SECONDS = 180.0  # until the first of them
LOOK_SECONDS = 1.0  # between looks at the processes
RING_WINDOWS = 1_000  # of the trial's ring: its own would take its time to make


@dataclass
class RoleUse:
    """The most that was seen of a role's process; memory is its share of what several map."""

    memory_bytes: int = 0
    handles: int = 0
    sockets: int = 0


@dataclass(frozen=True)
class Trial:
    """What a trial has shown."""

    roles: dict[str, RoleUse]
    records: list[dict[str, Any]]
    checkpoint_bytes: int
    record_bytes_per_s: float


def trial_config(config: RunConfig) -> RunConfig:
    """The same run with a ring and a warm-up that are over soon."""
    enough = config.learner.batch_size * config.window_spec().train
    replay = dataclasses.replace(
        config.replay,
        capacity=min(config.replay.capacity, max(RING_WINDOWS, config.learner.batch_size)),
        warmup_steps=min(config.replay.warmup_steps, enough),
    )
    return dataclasses.replace(config, replay=replay)


def run_trial(config: RunConfig, device: str, stop: StopSignal) -> Trial:
    """Train for some seconds. Raises ConfigError where no update comes, RoleDied, KeyboardInterrupt at ``stop``."""
    with tempfile.TemporaryDirectory(prefix="rmc-trial-") as place, _folder(config, Path(place) / "run") as folder:
        watcher = Monitor(folder, config, Console(quiet=True, force_terminal=False))
        try:
            uses = _train(config, folder, device, watcher, stop)
        finally:
            watcher.close()
        records = list(folder.records())
        seconds = records[-1]["time"] - records[0]["time"] if records else 0.0
        return Trial(
            uses,
            records,
            _checkpoint_bytes(folder),
            disk_bytes(folder.metrics, *folder.event_files()) / max(seconds, 1.0),
        )


@contextmanager
def _folder(config: RunConfig, path: Path) -> Iterator[RunFolder]:
    begun = RunFolder(path)
    make(begun)
    begun.write_config(config)  # a run that goes on may have what a new one has no use for
    folder = open_run(config, LaunchOptions(path))
    try:
        yield folder
    finally:
        folder.lock.release()


def _train(config: RunConfig, folder: RunFolder, device: str, watcher: Monitor, stop: StopSignal) -> dict[str, RoleUse]:
    run = LocalRun(config, folder, None, device, stop)
    uses: dict[str, RoleUse] = {}
    commands = {name: role.command.words for name, role in run.supervisor.roles.items()}
    try:
        run.supervisor.start()
        began, first, look_at = time.monotonic(), None, 0.0
        while not run.finished() and (first is None or time.monotonic() < first + TRAINED_SECONDS):
            if stop.requested:
                raise KeyboardInterrupt
            run.tend()
            watcher.watch(run.bus)
            if first is None and watcher.status.get("learner", "updates"):
                first = time.monotonic()
            if first is None and time.monotonic() > began + LONGEST_SECONDS:
                raise ConfigError("--dry-run", True, _unbegun(watcher))
            if time.monotonic() >= look_at:
                look_at = time.monotonic() + LOOK_SECONDS
                _look(commands, uses)
            time.sleep(TICK_SECONDS)
        run.supervisor.stop()
        watcher.watch(run.bus)
    finally:
        run.close()
    return uses


def _unbegun(watcher: Monitor) -> str:
    waits = [
        f"{role} for {record['waiting_for']}"
        for role, record in watcher.status.roles.items()
        if record.get("waiting_for")
    ]
    return f"no update within {LONGEST_SECONDS:.0f} s (waiting: {', '.join(waits)}); is the environment slow?"


def _look(commands: dict[str, tuple[str, ...]], uses: dict[str, RoleUse]) -> None:
    """Note what each process of this run holds now."""
    launcher = psutil.Process()
    for process in [launcher, *launcher.children(recursive=True)]:
        with suppress(psutil.Error):  # it has ended meanwhile
            name = "launcher" if process == launcher else _name(process.cmdline(), commands)
            use = uses.setdefault(name, RoleUse())
            use.memory_bytes = max(use.memory_bytes, _memory(process))
            use.handles = max(use.handles, process.num_fds())
            use.sockets = max(use.sockets, len(process.net_connections("all")))


def _name(words: list[str], commands: dict[str, tuple[str, ...]]) -> str:
    """Whose process it is, by its command line; what is nobody's an environment has started."""
    for role, command in commands.items():
        if tuple(words[-len(command) :]) == command:
            return role
    if MODEL_PROCESS in words:
        return "learner (model)"
    if "rmc.cli.fork_server" in words:
        return "fork server"
    return "redis" if words and words[-1].endswith("redis.sock") else "environments"


def _memory(process: psutil.Process) -> int:
    """The most until now: what an update takes for a moment counts. Pages that several map count in parts on Linux."""
    full = process.memory_full_info()
    return int(getattr(full, "pss", full.rss)) + max(0, _peak_bytes(process.pid) - int(full.rss))


def _peak_bytes(pid: int) -> int:
    """The largest resident size of a process so far; 0 where the system does not tell."""
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) << 10
    return 0


def _checkpoint_bytes(folder: RunFolder) -> int:
    """Of the largest."""
    checkpoints = CheckpointFolder(folder.checkpoints)
    return max((disk_bytes(checkpoints.path(number)) for number in checkpoints.numbers()), default=0)


def disk_bytes(*paths: Path) -> int:
    """Of files, and of all files below folders."""
    files = [file for path in paths for file in (path.rglob("*") if path.is_dir() else [path])]
    return sum(file.stat().st_size for file in files if file.is_file())
