"""What ``rmc train``, ``rmc resume`` and ``rmc evaluate`` do, and a run's config, for scripts and notebooks."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_type_hints

import gymnasium
from gymnasium.envs.registration import EnvSpec

from rmc.analysis.evaluation import FINAL_EPISODES
from rmc.analysis.run_evaluation import evaluate_run
from rmc.cli import training
from rmc.common.env.config import EnvConfig
from rmc.common.env.process_state import ProcessState, torch_as_imported
from rmc.common.env.registered import DM_CONTROL, PYBULLET
from rmc.common.errors import STOPPED_STATUS, ConfigError
from rmc.common.process import watchdog
from rmc.common.user_path import user_path
from rmc.deploy.monitor.recorded import Callback
from rmc.deploy.monitor.view import terminal
from rmc.deploy.run.config import RunConfig, checked, value_of_kind
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import PATH_VARIABLE, IfExists, InitParts, Launcher, LaunchOptions, TrackerName
from rmc.deploy.run.starts import last_launch


def train(
    config: RunConfig,
    run_dir: str | Path | None = None,
    *,
    launcher: Launcher = "local",
    device: str = "cpu",
    if_exists: IfExists = "resume",
    redis_url: str | None = None,
    ray_address: str = "auto",
    all_cpus: bool = False,
    tls: bool = False,
    init_from: str | Path | None = None,
    init_parts: InitParts = "all",
    track: TrackerName | Literal["off"] | None = None,
    track_project: str | None = None,
    track_tags: Sequence[str] = (),
    video_every: int | None = None,
    metrics_port: int | None = None,
    metrics_host: str = "127.0.0.1",
    callback: Callback | None = None,
) -> dict[str, Any]:
    """Train a run to its ``total_steps``, or continue the one in ``run_dir``; its ``result.json`` and ``run_dir``.

    A new run begins with the networks and the normaliser of the run or ``RUN:CHECKPOINT`` in ``init_from``, or with
    those of ``init_parts``. Progress goes to standard output. Call it from the main thread: Ctrl-C ends the run
    cleanly. With the launcher ``local``, the roles are processes of their own, which import the environment by its id.

    ``callback`` is called with each record of metrics.jsonl, in this thread. To end the run early, raise an error in
    it: once the run is saved, ``train`` raises it.

    Raises ConfigError for options that cannot work, before anything starts; RoleDied where a role keeps dying;
    KeyboardInterrupt where the run was stopped, which ``resume`` continues.
    """
    if isinstance(track_tags, str) or not isinstance(track_tags, Sequence):
        raise ConfigError("track_tags", track_tags, "take a list of texts")
    options = LaunchOptions(
        run_dir=None if run_dir is None else user_path(run_dir),
        if_exists=if_exists,
        init_from=None if init_from is None else str(init_from),
        init_parts=init_parts,
        launcher=launcher,
        device=str(device),
        redis_url=redis_url,
        ray_address=ray_address,
        all_cpus=all_cpus,
        tls=tls,
        track=track,
        track_project=track_project,
        track_tags=tuple(track_tags),
        video_every=video_every,
        metrics_port=metrics_port,
        metrics_host=metrics_host,
    )
    return _train(config, options, callback)


def load_config(run_dir: str | Path) -> RunConfig:
    """The options of a run, also an older one; to be read, or changed and given to ``train``. Raises ConfigError."""
    return RunFolder(user_path(run_dir)).config()


def resume(
    run_dir: str | Path,
    *,
    total_steps: int | None = None,
    actors: int | None = None,
    replay_ratio: float | None = None,
    learning_rate: float | None = None,
    launcher: Launcher | None = None,
    device: str | None = None,
    redis_url: str | None = None,
    metrics_port: int | None = None,
    callback: Callback | None = None,
) -> dict[str, Any]:
    """Continue the run in ``run_dir``; as ``train`` gives it. What is None stays as it was at the last start.

    Other options that may change are given to ``train``, with the run's whole config. Raises as ``train`` does.
    """
    folder = RunFolder(user_path(run_dir))
    config, options = folder.config(), last_launch(folder, launcher)
    settings: dict[str, Any] = {"total_steps": total_steps, "actors": actors}
    how: dict[str, Any] = {"device": device and str(device), "redis_url": redis_url, "metrics_port": metrics_port}
    how["all_cpus"] = None if actors is None else False  # a number of actors takes its place
    if replay_ratio is not None:
        settings["replay"] = replace(config.replay, replay_ratio=replay_ratio)
    if learning_rate is not None:
        settings["update"] = replace(config.update, learning_rate=learning_rate)
    return _train(replace(config, **_not_none(settings)), replace(options, **_not_none(how)), callback)


def _not_none(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


class _Callback:
    """The caller's, with torch as it was there. An error that it raises ends the run as Ctrl-C does, and is kept."""

    def __init__(self, function: Callback) -> None:
        self._function, self._callers = function, ProcessState.read()
        self.error: BaseException | None = None

    def __call__(self, record: dict[str, Any]) -> None:
        if self.error is not None:
            return
        try:
            with self._callers.of_torch():
                self._function(dict(record))
        except BaseException as error:  # also one that would end this process
            self.error = error
            if signal.getsignal(signal.SIGINT) is None:  # it goes to a program around Python, which may do anything
                raise
            ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
            signal.raise_signal(signal.SIGTERM if ignored else signal.SIGINT)


def _train(config: RunConfig, options: LaunchOptions, callback: Callback | None) -> dict[str, Any]:
    config = checked(config)
    _check_call(options)
    if callback is not None and not callable(callback):
        raise ConfigError("callback", callback, "take a function of one record")
    hears = None if callback is None else _Callback(callback)
    watchdog.warn()
    if options.launcher != "lockstep":
        _check_importable(config.env)
    with torch_as_imported():
        folder, status = training.train(config, options, terminal(), hears)
    if hears is not None and hears.error is not None:
        raise hears.error
    if status == STOPPED_STATUS:
        raise KeyboardInterrupt
    result = folder.result()
    assert result is not None  # written by every run that ends cleanly
    return result | {"run_dir": str(folder.path)}


def _check_call(options: LaunchOptions) -> None:
    """Raises ConfigError for what a command line could not say."""
    if threading.current_thread() is not threading.main_thread():
        fix = "is no main thread, which alone hears Ctrl-C; call it there, or start rmc train as a process"
        raise ConfigError("train", threading.current_thread().name, fix)
    kinds = get_type_hints(LaunchOptions)
    for name, value in vars(options).items():
        if name != "run_dir":  # a path already
            value_of_kind(kinds[name], list(value) if isinstance(value, tuple) else value, name)


def _check_importable(env: EnvConfig) -> None:
    """The roles' processes know no environment of this script's own. Raises ConfigError for such a one."""
    script = getattr(sys.modules["__main__"], "__file__", None)
    if script is not None:  # where modules beside it are, which this one can import
        os.environ[PATH_VARIABLE] = str(Path(script).resolve().parent)
    spec = gymnasium.registry.get(env.id)
    if spec is not None and not env.id.startswith((DM_CONTROL, PYBULLET)) and not _is_known_to_all(spec):
        fix = f'name the module that registers it, "module:{env.id}", or take launcher="lockstep"'
        raise ConfigError("ENV", env.id, f"is registered in this process alone, not in the roles' own; {fix}")


def _is_known_to_all(spec: EnvSpec) -> bool:
    """Whether every process that imports gymnasium has it, with the same time limit and the same class, if by name."""
    code = (
        "import gymnasium, sys; spec = gymnasium.registry[sys.argv[1]]; "
        "print((spec.entry_point, spec.max_episode_steps))"
    )
    done = subprocess.run([sys.executable, "-c", code, spec.id], capture_output=True, check=False, text=True)
    factory, limit = spec.entry_point, spec.max_episode_steps
    return done.stdout.endswith(f"{(factory, limit)}\n" if isinstance(factory, str) else f", {limit})\n")


def evaluate(
    run: str | Path, episodes: int = FINAL_EPISODES, *, checkpoint: str = "latest", flicker: float | None = None
) -> dict[str, Any]:
    """Play deterministic episodes with a policy's file, or a run's ``latest``, ``best`` or numbered checkpoint.

    A run of ``rmc baseline`` has its latest alone.

    ``flicker`` is the probability of a missing observation, by default the run's own. The keys are those of
    ``rmc evaluate --json``: ``eval_return_mean``, ``eval_return_std``, ``eval_episodes``, ``env_steps`` and more.

    Raises ConfigError; RmcError where the environment breaks in every episode.
    """
    watchdog.warn()
    with torch_as_imported():
        return evaluate_run(run, episodes, checkpoint, flicker)
