"""``rmc train`` from its checks to ``result.json``."""

import dataclasses
import json
import logging
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import ceil
from pathlib import Path
from statistics import mean
from typing import Any

from rich.console import Console

from rmc.common.bus.protocol import Bus
from rmc.common.bus.redis_url import shown
from rmc.common.checkpoint import PROGRESS, CheckpointFolder
from rmc.common.errors import ConfigError, RoleDied
from rmc.common.process.role import StopSignal
from rmc.deploy.local import launcher
from rmc.deploy.local.socket_folder import place_for_sockets
from rmc.deploy.local.supervisor import EXIT_CONFIG
from rmc.deploy.monitor import attach
from rmc.deploy.monitor.monitor import Monitor
from rmc.deploy.monitor.output import Output
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder, open_run
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.preflight import check_device, check_ring_fits, cores
from rmc.deploy.run.validation import validate

STOPPED = 130  # exit status after Ctrl-C, as shells have it
log = logging.getLogger(__name__)


def train(config: RunConfig, options: LaunchOptions, console: Console) -> int:
    """Train to the end, or to a stop signal; the exit status. Raises ConfigError before anything is started."""
    if options.launcher == "ray":
        return _train_on_ray(config, options, console)
    return conduct(config, prepare(config, options), options, console)


def conduct(config: RunConfig, folder: RunFolder, options: LaunchOptions, console: Console) -> int:
    """Be the launcher of a run whose folder is locked, from its first evaluation to its last."""
    status, Output.log = 1, folder.logs / "launcher.log"
    try:
        console.print(f"run folder {folder.path}", soft_wrap=True)
        before = _before(config, folder)
        console.print(f"before training: {_said(before)}")
        monitor = Monitor(folder, config, console)
        if options.launcher == "manual":
            console.print(f"start the roles with --run {folder.name}", soft_wrap=True)
        try:
            with signals_caught() as stop:  # before and after, nothing runs that Ctrl-C could not end at once
                finished = _launch(config, folder, options, monitor, stop)
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


def _train_on_ray(config: RunConfig, options: LaunchOptions, console: Console) -> int:
    """Hand a run to a launcher on the cluster's head, and watch it; Ctrl-C ends the run, a closed terminal does not."""
    from rmc.deploy.ray import launcher as ray_launcher
    from rmc.deploy.ray import placement

    enough = max(cores(), ceil(placement.reserved_cpus(config)) + config.actors)  # of a cluster of our own
    with ray_launcher.joined(options.ray_address, enough):
        return _watched_on_ray(config, options, console)


def _watched_on_ray(config: RunConfig, options: LaunchOptions, console: Console) -> int:
    from rmc.deploy.ray import launcher as ray_launcher
    from rmc.deploy.ray import placement

    if options.run_dir is not None and (options.run_dir / "secret").exists():
        ray_launcher.check_not_there(RunFolder(options.run_dir))
    placement.check_room(config, options.device)
    fit = placement.actors_that_fit(config)
    learner = dataclasses.replace(config.learner, threads=placement.learner_cpus(config))
    config = dataclasses.replace(config, learner=learner, actors=fit if options.all_cpus else config.actors)
    folder = prepare(config, options)
    folder.unlock()
    ray_launcher.launch(config, folder, options.device, options.all_cpus, options.tls)
    console.print(f"run folder {folder.path}", soft_wrap=True)
    with signals_caught(hangup=False) as stop:
        attach.watch(folder, console, _passes_on(stop, folder))
    return say_end(folder, console)


def _passes_on(stop: StopSignal, folder: RunFolder) -> Callable[[], bool]:
    """Whether the run's launcher is gone; tells it to stop, once, when we are."""
    from rmc.deploy.ray import launcher as ray_launcher

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


def prepare(config: RunConfig, options: LaunchOptions) -> RunFolder:
    """All checks that need no process, then the run's folder, locked. Raises ConfigError."""
    validate(config)
    spec = config.window_spec()
    if options.launcher != "ray":  # there, the learner's node has the device
        check_device(options.device)
    elif options.redis_url is not None:
        raise ConfigError("--redis-url", shown(options.redis_url), "a run on Ray has a Redis of its own, on the head")
    if options.all_cpus and options.launcher != "ray":
        raise ConfigError("--all-cpus", True, "give --launcher ray; elsewhere say how many --actors")
    if options.tls and options.launcher != "ray":
        raise ConfigError("--tls", True, "give --launcher ray; elsewhere take a --redis-url of rediss://")
    if options.launcher == "lockstep" and config.replay.replay_shards > 1:
        raise ConfigError(
            "--replay-shards", config.replay.replay_shards, "a lockstep run has one; use --launcher local"
        )
    if options.launcher in ("local", "ray"):
        place_for_sockets()
    if options.launcher == "manual" and options.redis_url is None:
        raise ConfigError("--redis-url", None, "say which Redis the roles that you start by hand will use")
    if options.redis_url is not None:
        launcher.check_redis(options.redis_url)
    if options.run_dir is not None:
        check_ring_fits(spec, config.replay.capacity, options.run_dir.resolve() / "replay")
    else:
        check_ring_fits(spec, config.replay.capacity, Path("runs").resolve())
    return open_run(config, options.run_dir, options.if_exists)


def _launch(config: RunConfig, folder: RunFolder, options: LaunchOptions, monitor: Monitor, stop: StopSignal) -> bool:
    if options.launcher == "local":
        return launcher.train(config, folder, options.redis_url, options.device, monitor, stop)

    if options.launcher == "ray":
        from rmc.deploy.ray import launcher as ray_launcher  # Ray is an extra, and slow to import
        from rmc.deploy.ray import run

        with ray_launcher.joined(options.ray_address):
            return run.train(config, folder, options.device, options.all_cpus, options.tls, monitor, stop)

    if options.launcher == "manual":
        assert options.redis_url is not None  # prepare has seen to it
        return launcher.attend(config, folder, options.redis_url, monitor, stop)

    import torch

    from rmc.deploy.local import lockstep

    def watch(bus: Bus) -> None:
        monitor.watch(bus)

    torch.set_num_threads(config.learner.threads or 1)  # the bits may depend on it, so it must not on the machine
    lockstep.train(config, folder.path, watch, stop, options.device)
    return not stop.requested


def _before(config: RunConfig, folder: RunFolder) -> dict[str, Any]:
    """How the untrained policy plays: at a run's first start it does so, later ones read it."""
    kept = folder.initial()
    if kept is not None:
        return kept
    from rmc.analysis import evaluation  # imports torch

    played = evaluation.evaluate_blob(config, evaluation.initial_policy(config), evaluation.FINAL_EPISODES)
    folder.write_initial(played)
    return played


def _result(config: RunConfig, folder: RunFolder, monitor: Monitor, before: dict[str, Any]) -> dict[str, Any]:
    from rmc.analysis.evaluation import FINAL_EPISODES, evaluate_checkpoint

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
