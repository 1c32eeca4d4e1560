"""Opens a run's folder: a new one, or one that goes on, with what may be other then."""

import logging
import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import COUNTERS, RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.option_names import changes, option
from rmc.deploy.run.starts import begun_with, format_begun, has_saved, note_start
from rmc.deploy.run.tracking import choose_tracking, keep_tracking
from rmc.deploy.run.validation import validate_new

if TYPE_CHECKING:  # imports torch
    from rmc.deploy.run.warm_start import InitialCheckpoint

# What a finished run takes: a last evaluation that was cut is played again, and fewer steps wait for none.
LAST_EVALUATION = {"evaluator.episodes", "evaluator.evaluation_seconds", "env.env_timeout", "total_steps"}
SAME_AGENT = {  # what a run that goes on may have otherwise, and learns the same
    "total_steps",
    "actors",
    "env.env_timeout",
    "learner.threads",
    "learner.keep_checkpoints",
    "learner.checkpoint_steps",
    "evaluator.episodes",
    "evaluator.evaluation_seconds",
}
MAY_CHANGE = SAME_AGENT | {  # that, and what is read afresh at every start: no stored state depends on it
    "actor.envs_per_actor",
    "actor.refresh_steps",
    "actor.chunk_windows",
    "actor.chunk_seconds",
    "actor.unacked_bytes",
    "replay.replay_ratio",
    "replay.priority_exponent",
    "update.learning_rate",
    "update.memory_learning_scale",
    "update.alpha_learning_rate",
    "update.target_entropy",
    "update.gamma",
    "update.polyak",
    "update.clip_norm",
    "update.policy_delay",
    "update.n_step",
    "update.eta",
    "update.curiosity",
    "update.curiosity_steps",
    "learner.batch_size",
    "learner.importance_exponent",
    "learner.publish_updates",
    "learner.precision",
}
log = logging.getLogger(__name__)
LEFT = {".lock", "checkpoints", "logs", "history.jsonl", ".config.json"}  # by a start that is killed before its config
WHY_NOT = {  # by the part of the config, and then by the option
    "env": "its experience is from that environment",
    "window": "its ring holds windows of that length",
    "agent": "its networks were made so",
    "actor": "its ring holds windows that were made so",
    "replay": "its ring was made so",
    "update": "its networks and optimisers belong to that algorithm",
    "seed": "its random numbers began with that",
    "preset": "its other options came from that",
    "replay.warmup_steps": "its first draw depends on it",
    "actor.reward_scale": "the rewards in its ring are scaled by that",
    "update.policy_ema_updates": "its average belongs to that",
}


def open_run(
    config: RunConfig, options: LaunchOptions, check: Callable[[RunFolder], None] = lambda _: None
) -> RunFolder:
    """Make or take up a run's folder, locked. Raises ConfigError before anything is written where it may not be.

    ``options`` say which folder, how it is started, for its history, and what a new one begins with.
    ``check`` is asked once it is locked, and may raise ConfigError.
    """
    folder = _named(options.run_dir or Path("runs") / default_name(config.env.id, config.preset, config.seed))
    there = options.goes_on
    tracking = choose_tracking(options)
    before, initial = check_start(config, options)
    if options.run_dir is None or options.if_exists == "new":
        folder = new_folder(folder.path)
    make(folder)
    folder.lock.take()
    try:
        check(folder)
        if not there:
            _check_still_new(folder)
            forget_start(folder)
        if initial is not None:  # before there is a config, without which it is no run
            CheckpointFolder(folder.checkpoints).save(0, initial.files)
        note_start(folder, changes(before, config), options, initial.origin if initial is not None else None)
        folder.write_config(config)
        folder.write_sizes(config.sizes())
        keep_tracking(folder, tracking)
        folder.secret()
        folder.reopen(config.total_steps)  # last: a start that fails before takes no result along
    except BaseException:  # a notebook lives on, and would keep the lock
        folder.lock.give_back()
        raise
    return folder


def check_start(config: RunConfig, options: LaunchOptions) -> "tuple[RunConfig, InitialCheckpoint | None]":
    """The config that the run had before, and what a new one begins with. Raises ConfigError; writes nothing."""
    if options.run_dir is not None and options.goes_on:
        return taken_up(_named(options.run_dir), config, options), None
    validate_new(config)
    if options.run_dir is not None and options.if_exists != "new":
        check_free(_named(options.run_dir))
    if options.init_from is None:
        return config, None
    from rmc.deploy.run import warm_start  # imports torch

    return config, warm_start.prepare(config, options.init_from, options.init_parts)


def _named(path: Path) -> RunFolder:
    """A folder that may not be there yet. Raises ConfigError where a file could not hold its whole path as text."""
    folder = RunFolder(path)
    if os.fsencode(folder.path).decode(errors="replace") != str(folder.path):
        raise ConfigError("--run-dir", str(folder.path), "is no UTF-8; give another")
    return folder


def plain_name(env_id: str) -> str:
    """An environment's id as part of a folder's name."""
    return env_id.replace(":", "_").replace("/", "_")


def default_name(env_id: str, kind: str, seed: int) -> str:
    """Of a run's folder, with the time."""
    return f"{plain_name(env_id)}__{kind}__{seed}__{time.strftime('%Y%m%d-%H%M%S')}"


def new_folder(path: Path) -> RunFolder:
    """A folder of that name that was not there, or beside it: two starts in the same second get one each."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in count(1):
            with suppress(FileExistsError):
                folder = RunFolder(path if number == 1 else path.with_name(f"{path.name}-{number}"))
                folder.path.mkdir(0o700)
                break
    except OSError as error:
        raise _creation_error(path, error) from None
    return folder


def _creation_error(path: Path, error: OSError) -> ConfigError:
    return ConfigError("--run-dir", str(path), f"cannot be made ({error.strerror}); give another")


def make(folder: RunFolder) -> None:
    """Its folders, its owner's alone. Raises ConfigError."""
    try:
        folder.path.mkdir(parents=True, exist_ok=True)
        if not (folder.path / "config.json").exists():
            with suppress(OSError):  # a folder of another owner, which we may write; a disk without modes
                folder.path.chmod(0o700)  # what a later owner opens to others stays open
        for path in (folder.checkpoints, folder.logs):
            path.mkdir(exist_ok=True)
    except OSError as error:
        raise _creation_error(folder.path, error) from None


def check_free(folder: RunFolder) -> None:
    """Raises ConfigError where something else is at its path."""
    if has_more_than_a_start(folder):
        raise ConfigError("--run-dir", str(folder.path), "is there and is no run's folder; give another one")


def has_more_than_a_start(folder: RunFolder) -> bool:
    """Whether something is at its path that a start without a config does not leave, one that was killed early on."""
    if not folder.path.is_dir():
        return folder.path.exists()
    there = list(folder.path.iterdir())
    if any(path.name not in LEFT or path.is_symlink() for path in there):  # a link shows what is another's
        return True
    kept = (folder.checkpoints / name for name in ("000000000", ".tmp-000000000"))
    initial = {file for path in kept for file in path.glob("*")}
    files = {path for path in folder.path.rglob("*") if path.is_symlink() or not path.is_dir()}
    return not files <= initial | {folder.path / name for name in LEFT}


def _check_still_new(folder: RunFolder) -> None:
    """Raises ConfigError where another start has made a run there since that was looked at."""
    if (folder.path / "config.json").exists():
        raise ConfigError("--run-dir", str(folder.path), "another start has just made it; start again to continue it")


def forget_start(folder: RunFolder) -> None:
    """Remove what one has left that came to no config. The folder is locked, and has nothing else."""
    for path in folder.checkpoints.iterdir():
        shutil.rmtree(path)
    folder.history_file.unlink(missing_ok=True)


def taken_up(folder: RunFolder, config: RunConfig, options: LaunchOptions) -> RunConfig:
    """The config that a run had which continues this one. Raises ConfigError where it may not."""
    if options.if_exists == "fail":
        raise ConfigError("--run-dir", str(folder.path), "is there already; use --if-exists resume or new")
    before = folder.config()
    _check_changes(folder, before, config)
    folder.check_sizes(config.env.id, config.sizes())
    newest = check_checkpoints(folder)
    if options.launcher != "manual":  # whose learner and replay servers may keep theirs elsewhere
        _check_kept(folder, newest, options.launcher == "ray")
    _check_initial(folder, newest, config.total_steps)
    _check_begun(folder, options)
    _check_unfinished(folder, before, config, options.launcher == "ray")
    return before


def _check_changes(folder: RunFolder, before: RunConfig, config: RunConfig) -> None:
    """Raises ConfigError for the first that may not be."""
    changed = changes(before, config)
    for path in ["env.id", "preset", *changed]:
        if path in changed and path not in MAY_CHANGE:
            name = "ENV" if path == "env.id" else option(path)
            why = WHY_NOT.get(path) or WHY_NOT.get(path.partition(".")[0], "that is for good")
            was, now = changed[path]
            fix = f"the run in {folder.path} has {was!r}, and {why}; use that, or another --run-dir"
            raise ConfigError(name, now, fix)


def _check_unfinished(folder: RunFolder, before: RunConfig, config: RunConfig, on_ray: bool) -> None:
    """Raises ConfigError for the first change that would wait for steps that nobody asks for."""
    result = folder.result()
    if result is None or result["env_steps"] < config.total_steps:
        return
    fitted = {"actors", "learner.threads"} if on_ray else set()  # to what the cluster has now
    for path, (_, now) in changes(before, config).items():
        if path not in LAST_EVALUATION | fitted:
            fix = f"all {result['env_steps']:,} steps are trained; leave it, or take more --total-steps"
            raise ConfigError(option(path), now, fix)


def _check_kept(folder: RunFolder, newest: int | None, on_ray: bool) -> None:
    """Raises ConfigError where a copy lacks what was learnt, or how far it came: it would silently train anew."""
    if newest is None and (has_saved(folder) or begun_with(folder)):
        fix = "has lost its checkpoints; restore them, or take another --run-dir"
        raise ConfigError("--run-dir", str(folder.path), fix)
    counted = on_ray or folder.rings() or (folder.path / COUNTERS).exists()
    if newest and not counted:
        fix = f"has neither its replay buffer nor {COUNTERS}, which counts its steps; restore one of them"
        raise ConfigError("--run-dir", str(folder.path), f"{fix}, or begin another run with --init-from")


def _check_initial(folder: RunFolder, newest: int | None, total_steps: int) -> None:
    """Raises ConfigError where nobody can tell any more how the networks played that it began with."""
    if newest and begun_with(folder) and folder.initial() is None:
        result = folder.result()
        if result is None or result["env_steps"] < total_steps:
            fix = "is lost or damaged, and so is what the run began with; restore that file"
            raise ConfigError("RUN", str(folder.initial_file), fix)


def _check_begun(folder: RunFolder, options: LaunchOptions) -> None:
    """Raises ConfigError where it is to begin with other weights than it did."""
    if options.init_from is not None and begun_with(folder).get("asked") != [options.init_from, options.init_parts]:
        fix = f"the run in {folder.path} began {format_begun(folder)}; leave it, or take another --run-dir"
        raise ConfigError("--init-from", options.init_from, fix)


def check_checkpoints(folder: RunFolder) -> int | None:
    """The newest one's update, if there is one. Raises ConfigError where none is whole; damaged newer ones are told."""
    checkpoints = CheckpointFolder(folder.checkpoints)
    newest = checkpoints.latest()
    if newest is None and checkpoints.damaged:
        fault = checkpoints.damaged[max(checkpoints.damaged)]
        raise ConfigError("--run-dir", str(folder.path), f"{fault}; none is whole, so use another --run-dir")
    if newest is not None and checkpoints.damaged:
        log.warning("the run goes on from the checkpoint of update %d", newest[0])
    return None if newest is None else newest[0]
