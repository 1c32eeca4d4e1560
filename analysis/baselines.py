"""``rmc baseline``: stable-baselines3's agents, trained on our environments and judged by our evaluator.

The run's folder looks like that of ``rmc train``, so that ``rmc plot`` reads both. Imported only where the extra
``baselines`` is installed.
"""

import dataclasses
import shutil
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from rmc.actors.evaluator import evaluation_record, first_start, play_episodes
from rmc.analysis.baseline_model import PROGRESS, BaselineModel, saved_player, saved_states
from rmc.analysis.baseline_run import BaselineRun, Stopped, evaluated_steps, initial_return
from rmc.analysis.baseline_settings import BaselineConfig, read_config, validate
from rmc.analysis.evaluation import Watch, missing_shares
from rmc.common.bus.metrics_record import is_complete
from rmc.common.env.make import env_layout, make_env
from rmc.common.errors import STOPPED_STATUS, ConfigError
from rmc.common.process.role import StopSignal
from rmc.common.return_text import return_text
from rmc.deploy.run.env_sizes import layout_sizes
from rmc.deploy.run.folder import RunFolder, read_object
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import default_name, forget_start, has_more_than_a_start, make, new_folder
from rmc.deploy.run.option_names import changes, option
from rmc.deploy.run.starts import note_start, resume_command
from rmc.deploy.run.state import remedy
from rmc.deploy.run.validation import validate_new_env

MAY_CHANGE = {"total_steps", "threads", "precision", "checkpoint_steps", "episodes", "env.env_timeout"}
Changes = dict[str, list[Any]]  # by the option's path, what it was and is


def train(config: BaselineConfig, run_dir: Path | None, console: Console, stop: StopSignal) -> int:
    """Train to the end, or to a stop signal; the exit status. Raises ConfigError before anything is written."""
    validate(config)
    sizes = layout_sizes(env_layout(config.env))
    folder, changed = _open_folder(config, run_dir, sizes)
    with ExitStack() as leave:
        try:
            _set_torch(config)
            model = leave.enter_context(closing(BaselineModel(config, _newest_state(folder, console))))
            _write_start(config, folder, sizes, changed)
        except BaseException:  # this one was refused
            folder.lock.give_back()
            raise
        status = 1
        try:
            console.print(f"run folder {folder.path}", soft_wrap=True)
            status = _conduct(config, folder, model, console, stop)
        finally:
            folder.lock.release(status)
    return status


def _newest_state(folder: RunFolder, console: Console) -> Path | None:
    """What the run goes on from; None where it begins. Raises ConfigError where that of a finished run is gone."""
    if states := saved_states(folder):
        return states[-1]
    if folder.result() is not None:
        raise ConfigError("RUN", str(folder.path), "has lost its checkpoint; restore it, or take another --run-dir")
    if steps := evaluated_steps(folder):  # killed before it was saved
        console.print(f"no checkpoint is there of the {steps:,} steps before; they begin anew", soft_wrap=True)
    return None


def _set_torch(config: BaselineConfig) -> None:
    """What an action's last bits depend on, the same to train and to evaluate."""
    torch.set_num_threads(config.threads)
    torch.set_flush_denormal(True)  # as our learner does


def _conduct(
    config: BaselineConfig, folder: RunFolder, model: BaselineModel, console: Console, stop: StopSignal
) -> int:
    if (result := folder.result()) is not None and is_complete(result):  # no step is missing: it would be gone else
        return _print_end(folder, result, console)
    result, steps = None, 0
    with suppress(Stopped), closing(BaselineRun(config, folder, model, console, stop)) as run:
        run.train()
        steps = run.steps
        result = None if stop.requested else run.result()
    if result is None:
        console.print(f"stopped at step {steps:,}; to go on:")
        console.print(f"  {resume_command(folder)}", soft_wrap=True)
        return STOPPED_STATUS
    folder.write_result(result)
    return _print_end(folder, result, console)


def _print_end(folder: RunFolder, result: dict[str, Any], console: Console) -> int:
    returns = return_text(result["eval_return_mean"], result["eval_return_std"])
    console.print(f"after training: return {returns}; {folder.result_file}")
    return 0


def _open_folder(config: BaselineConfig, run_dir: Path | None, sizes: dict[str, Any]) -> tuple[RunFolder, Changes]:
    """Make or take up a run's folder, locked, as ``open_run``; what is other than before. Raises ConfigError."""
    if run_dir is None or not (run_dir / "config.json").exists():
        validate_new_env(config.env)
    name = default_name(config.env.id, f"{config.algorithm}-{config.settings}", config.seed)
    folder = RunFolder(run_dir) if run_dir is not None else new_folder(Path("runs").resolve() / name)
    there = (folder.path / "config.json").exists() and folder.is_baseline()
    before = read_config(folder) if there else config
    changed = changes(before, config)
    if refused := next((path for path in changed if path not in MAY_CHANGE), None):
        was, now = changed[refused]
        fix = f"the run in {folder.path} has {was!r}; use that, or another --run-dir"
        name = option(refused)
        raise ConfigError(name, now, fix)
    if there:
        folder.check_sizes(config.env.id, sizes)
        initial_return(folder)
    elif has_more_than_a_start(folder):
        raise ConfigError("--run-dir", str(folder.path), "is there and is no baseline's; give another one")
    make(folder)
    folder.lock.take()
    if not there:
        forget_start(folder)
    return folder, changed


def _write_start(config: BaselineConfig, folder: RunFolder, sizes: dict[str, Any], changed: Changes) -> None:
    """That it begins, or goes on; a start that fails before takes no result along."""
    for leftover in set(folder.checkpoints.glob("[0-9]*")) - set(saved_states(folder)):  # by a crash amid a save
        shutil.rmtree(leftover)
    note_start(folder, changed, LaunchOptions(folder.path), None)
    folder.write_config(config)
    folder.write_sizes(sizes)
    folder.reopen(config.total_steps)


def evaluate(
    folder: RunFolder,
    episodes: int,
    flicker: float | None = None,
    seconds: float = 0.0,
    watch: Watch = lambda _: None,
    env_timeout: float | None = None,
) -> dict[str, Any]:
    """Deterministic episodes of what a baseline's run saved last, as ``evaluate_policy``. Raises ConfigError."""
    config, states = read_config(folder), saved_states(folder)
    if not states:
        raise ConfigError("RUN", str(folder.path), f"it has no checkpoint yet; {remedy(folder)}")
    env = config.env if flicker is None else dataclasses.replace(config.env, flicker=flicker)
    env = env if env_timeout is None else dataclasses.replace(env, env_timeout=env_timeout)
    folder.check_sizes(env.id, layout_sizes(env_layout(env)))
    _set_torch(config)
    progress = read_object(states[-1] / PROGRESS, "env_steps", "updates")
    player = saved_player(config, states[-1], env)
    seed = first_start(config.seed, final=True)
    rollout = play_episodes(player, lambda: make_env(env), episodes, seed, seconds, watch)
    about = {"env": env.id, "preset": config.name, "seed": config.seed, **progress}
    return about | evaluation_record(rollout) | missing_shares(env)
