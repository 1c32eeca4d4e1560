"""``rmc train`` from its checks to ``result.json``."""

import dataclasses
import json
import logging
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from statistics import mean
from typing import Any, Literal

import torch
from rich.console import Console

from common.bus import Bus
from common.checkpoint import CheckpointFolder
from common.errors import ConfigError, RoleDied
from common.redis_url import shown
from common.role import StopSignal
from deploy import attachment, local, lockstep
from deploy.evaluation import FINAL_EPISODES, evaluate_blob, evaluate_checkpoint, initial_policy
from deploy.monitor import Monitor
from deploy.presets import RunConfig, validate
from deploy.resources import check_ring_fits
from deploy.roles import check_device, cores
from deploy.run_folder import IfExists, RunFolder, open_run
from deploy.supervisor import EXIT_CONFIG
from learner.learner import PROGRESS

Launcher = Literal["local", "ray", "lockstep", "manual"]
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
    ray_address: str = "auto"
    all_cpus: bool = False
    tls: bool = False


def train(config: RunConfig, placement: Placement, console: Console) -> int:
    """Train to the end, or to a stop signal; the exit status. Raises ConfigError before anything is started."""
    if placement.launcher == "ray":
        return _train_on_ray(config, placement, console)
    return conduct(config, prepare(config, placement), placement, console)


def conduct(config: RunConfig, folder: RunFolder, placement: Placement, console: Console) -> int:
    """Be the launcher of a run whose folder is locked, from its first evaluation to its last."""
    status = 1
    try:
        console.print(f"run folder {folder.path}", soft_wrap=True)
        before = evaluate_blob(config, initial_policy(config), FINAL_EPISODES)
        console.print(f"before training: {_said(before)}")
        monitor = Monitor(folder, config, console)
        if placement.launcher == "manual":
            console.print(f"start the roles with --run {folder.name}", soft_wrap=True)
        try:
            with signals_caught() as stop:  # before and after, nothing runs that Ctrl-C could not end at once
                finished = _launch(config, folder, placement, monitor, stop)
        finally:
            monitor.close()
        if not finished:
            status = STOPPED
            return _say_stopped(folder, config, monitor.board.env_steps, console)
        result = _result(config, folder, monitor, before)
        folder.write_result(result)
        status = 0
    except ConfigError:
        status = EXIT_CONFIG
        raise
    except KeyboardInterrupt:
        status = STOPPED
        raise
    finally:
        folder.unlock(status)
    console.print(f"before training: {_said(before)}")
    return _say_result(folder, console)


def _train_on_ray(config: RunConfig, placement: Placement, console: Console) -> int:
    """Hand a run to a launcher on the cluster's head, and watch it; Ctrl-C ends the run, a closed terminal does not."""
    from deploy import ray_launcher, ray_places

    enough = max(cores(), ceil(ray_places.reserved_cpus(config)) + config.actors)  # of a cluster of our own
    with ray_launcher.joined(placement.ray_address, enough):
        return _watched_on_ray(config, placement, console)


def _watched_on_ray(config: RunConfig, placement: Placement, console: Console) -> int:
    from deploy import ray_launcher, ray_places

    if placement.run_dir is not None and (placement.run_dir / "secret").exists():
        ray_launcher.check_not_there(RunFolder(placement.run_dir))
    ray_places.check_room(config, placement.device)
    fit = ray_places.actors_that_fit(config)
    learner = dataclasses.replace(config.learner, threads=ray_places.learner_cpus(config))
    config = dataclasses.replace(config, learner=learner, actors=fit if placement.all_cpus else config.actors)
    folder = prepare(config, placement)
    folder.unlock()
    ray_launcher.launch(config, folder, placement.device, placement.all_cpus, placement.tls)
    console.print(f"run folder {folder.path}", soft_wrap=True)
    with signals_caught(hangup=False) as stop:
        attachment.watch(folder, console, _passes_on(stop, folder))
    return say_end(folder, console)


def _passes_on(stop: StopSignal, folder: RunFolder) -> Callable[[], bool]:
    """Whether the run's launcher is gone; tells it to stop, once, when we are."""
    from deploy import ray_launcher

    told: int | None = None  # which of the launchers, if it is started again

    def gone() -> bool:
        nonlocal told
        if stop.requested and (trainer := folder.trainer()) not in (None, told):
            told = trainer
            os.kill(trainer, signal.SIGTERM)
        return not ray_launcher.is_there(folder)

    return gone


def say_end(folder: RunFolder, console: Console) -> int:
    """Print how a run ended that another process trained; its exit status."""
    status, config = folder.ended(), folder.config()
    if status == 0:
        return _say_result(folder, console)
    if status == STOPPED:
        found = CheckpointFolder(folder.checkpoints).latest()
        steps = json.loads(found[1][PROGRESS])["env_steps"] if found else 0
        return _say_stopped(folder, config, steps, console)
    log_file = folder.logs / "launcher.log"
    words = log_file.read_text(errors="replace").strip().splitlines()[-30:] if log_file.exists() else []
    console.print("\n".join(words), soft_wrap=True)
    raise RoleDied(f"the launcher of {folder.path} ended with status {status}; the whole of its words: {log_file}")


@contextmanager
def signals_caught(hangup: bool = True) -> Iterator[StopSignal]:
    """SIGTERM, SIGINT and a closed terminal only set the signal, for as long as this lasts."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
    stop = StopSignal()
    stop.install()
    if hangup and before[signal.SIGHUP] != signal.SIG_IGN:  # nohup ignores it: the terminal may close
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
    if placement.launcher != "ray":  # there, the learner's node has the device
        check_device(placement.device)
    elif placement.redis_url is not None:
        raise ConfigError("--redis-url", shown(placement.redis_url), "a run on Ray has a Redis of its own, on the head")
    if placement.all_cpus and placement.launcher != "ray":
        raise ConfigError("--all-cpus", True, "give --launcher ray; elsewhere say how many --actors")
    if placement.tls and placement.launcher != "ray":
        raise ConfigError("--tls", True, "give --launcher ray; elsewhere take a --redis-url of rediss://")
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

    if placement.launcher == "ray":
        from deploy import cluster, ray_launcher  # Ray is an extra, and slow to import

        with ray_launcher.joined(placement.ray_address):
            return cluster.train(config, folder, placement.device, placement.all_cpus, placement.tls, monitor, stop)

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


def _say_stopped(folder: RunFolder, config: RunConfig, env_steps: int, console: Console) -> int:
    command = f"rmc train {config.env.id} --preset {config.preset} --seed {config.seed} --run-dir {folder.path}"
    console.print(f"stopped at environment step {env_steps:,}; to go on, give the same options and")
    console.print(f"  {command}", soft_wrap=True)
    return STOPPED


def _say_result(folder: RunFolder, console: Console) -> int:
    result = folder.result()
    assert result is not None
    console.print(f"after training:  {_said(result)}")
    facts = f"{result['env_steps']:,} environment steps, {result['updates']:,} updates, {result['wall_s']:,.0f} s"
    console.print(f"{facts}; {folder.result_file}", soft_wrap=True)
    return 0
