"""``rmc train`` from its checks to ``result.json``."""

import logging
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any, Literal

import torch
from rich.console import Console

from common.bus import Bus
from common.checkpoint import CheckpointFolder
from common.errors import ConfigError
from common.role import StopSignal
from deploy import local, lockstep
from deploy.evaluation import evaluate_blob, evaluate_checkpoint, initial_policy
from deploy.monitor import Monitor
from deploy.presets import RunConfig, validate
from deploy.resources import check_ring_fits
from deploy.roles import check_device
from deploy.run_folder import IfExists, RunFolder, open_run

Launcher = Literal["local", "lockstep", "manual"]
FINAL_EPISODES = 10  # of the last evaluation
STOPPED = 130  # exit status after Ctrl-C, as shells have it
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Placement:
    """Where and on what a run runs; nothing here changes what it learns."""

    run_dir: Path | None
    if_exists: IfExists
    launcher: Launcher
    device: str
    redis_url: str | None


def train(config: RunConfig, placement: Placement, console: Console) -> int:
    """Train to the end, or to a stop signal; the exit status. Raises ConfigError before anything is started."""
    folder = prepare(config, placement)
    try:
        console.print(f"run folder {folder.path}", soft_wrap=True, highlight=False)
        before = evaluate_blob(config, initial_policy(config), FINAL_EPISODES)
        console.print(f"before training: {_said(before)}", highlight=False)
        if placement.launcher == "manual":
            console.print(f"start the roles with --run {folder.name}", soft_wrap=True, highlight=False)
        monitor = Monitor(folder, config, console)
        try:
            with _signals_caught() as stop:  # before and after, nothing runs that Ctrl-C could not end at once
                finished = _launch(config, folder, placement, monitor, stop)
        finally:
            monitor.close()
        if not finished:
            return _say_stopped(folder, config, monitor, console)
        result = _result(config, folder, monitor, before)
        CheckpointFolder(folder.checkpoints).mark_best(result["updates"], result["eval_return_mean"])
        folder.write_result(result)
    finally:
        folder.unlock()
    return _say_result(folder, before, console)


@contextmanager
def _signals_caught() -> Iterator[StopSignal]:
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
    stop = StopSignal()
    stop.install()
    if before[signal.SIGHUP] != signal.SIG_IGN:  # nohup ignores it: the terminal may close
        signal.signal(signal.SIGHUP, lambda *_: stop.request())
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def prepare(config: RunConfig, placement: Placement) -> RunFolder:
    """All checks that need no process, then the run's folder, locked. Raises ConfigError."""
    validate(config)
    spec = config.window_spec()
    check_device(placement.device)
    if placement.launcher == "lockstep" and config.replay.replay_shards > 1:
        raise ConfigError(
            "--replay-shards", config.replay.replay_shards, "a lockstep run has one; use --launcher local"
        )
    if placement.launcher == "manual" and placement.redis_url is None:
        raise ConfigError("--redis-url", None, "say which Redis the roles that you start by hand will use")
    if placement.redis_url is not None:
        local.check_redis(placement.redis_url)
    if placement.run_dir is not None:
        check_ring_fits(spec, config.replay.capacity, placement.run_dir.resolve() / "replay")
    else:
        check_ring_fits(spec, config.replay.capacity, Path("runs").resolve())
    return open_run(config, placement.run_dir, placement.if_exists)


def _launch(config: RunConfig, folder: RunFolder, placement: Placement, monitor: Monitor, stop: StopSignal) -> bool:
    if placement.launcher == "local":
        return local.train(config, folder, placement.redis_url, placement.device, monitor, stop)

    if placement.launcher == "manual":
        assert placement.redis_url is not None  # prepare has seen to it
        return local.attend(config, folder, placement.redis_url, monitor, stop)

    def watch(bus: Bus) -> None:
        monitor.watch(bus)

    torch.set_num_threads(config.learner.threads or 1)  # the bits may depend on it, so it must not on the machine
    lockstep.train(config, folder.path, watch, stop, placement.device)
    return not stop.requested


def _result(config: RunConfig, folder: RunFolder, monitor: Monitor, before: dict[str, Any]) -> dict[str, Any]:
    after = evaluate_checkpoint(folder, config, "latest", FINAL_EPISODES)
    return {
        **after,
        "initial_return_mean": before["eval_return_mean"],
        "wall_s": monitor.wall_seconds,
        "replay_ratio": monitor.board.replay("replay_ratio", mean),
        "restarts": sum(monitor.restarts().values()),
    }


def _said(evaluation: dict[str, Any]) -> str:
    mean, deviation = evaluation["eval_return_mean"], evaluation["eval_return_std"]
    return f"return {mean:,.1f} ± {deviation:,.1f} over {evaluation['eval_episodes']} deterministic episodes"


def _say_stopped(folder: RunFolder, config: RunConfig, monitor: Monitor, console: Console) -> int:
    command = f"rmc train {config.env.id} --preset {config.preset} --seed {config.seed} --run-dir {folder.path}"
    console.print(f"stopped at environment step {monitor.board.env_steps:,}; to go on, give the same options and")
    console.print(f"  {command}", soft_wrap=True, highlight=False)
    return STOPPED


def _say_result(folder: RunFolder, before: dict[str, Any], console: Console) -> int:
    result = folder.result()
    assert result is not None
    console.print(f"before training: {_said(before)}", highlight=False)
    console.print(f"after training:  {_said(result)}", highlight=False)
    facts = f"{result['env_steps']:,} environment steps, {result['updates']:,} updates, {result['wall_s']:,.0f} s"
    console.print(f"{facts}; {folder.result_file}", soft_wrap=True, highlight=False)
    return 0
