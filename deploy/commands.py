"""What each command of the command line does."""

import json
import logging
import os
from contextlib import suppress
from pathlib import Path

from rich.console import Console

from common.envs import EnvConfig
from common.errors import ConfigError
from deploy import env_check, export, options, roles, training
from deploy.evaluation import evaluate_checkpoint
from deploy.run_folder import RunFolder
from deploy.view import Board, table


def execute(command: options.Command) -> int:
    """Run a parsed command; its exit status. Raises RmcError."""
    if isinstance(command, options.Train):
        logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
        return training.train(command.config(), command.placement(), Console())
    if isinstance(command, options.Evaluate):
        return evaluate(command)
    if isinstance(command, options.Export):
        return export_policy(command)
    if isinstance(command, options.CheckEnv):
        return check_env(command)
    if isinstance(command, options.Stats):
        return stats(command)
    return run_role(command)


def run_role(command: options.ActorRole | options.ReplayRole | options.LearnerRole | options.EvaluatorRole) -> int:
    """Be one role of a run until it ends."""
    url = command.redis_url or os.environ.get(roles.URL_VARIABLE, "")
    if not url:
        raise ConfigError("--redis-url", url, f"say where the run's Redis is, or set {roles.URL_VARIABLE}")
    if isinstance(command, options.ActorRole):
        roles.run_actor(roles.Place(command.run, url), command.index)
    elif isinstance(command, options.ReplayRole):
        roles.run_replay(roles.Place(command.run, url, command.secret_file), command.folder, command.listen)
    elif isinstance(command, options.LearnerRole):
        roles.run_learner(roles.Place(command.run, url, command.secret_file), command.folder, command.device)
    else:
        roles.run_evaluator(roles.Place(command.run, url))
    return 0


def evaluate(command: options.Evaluate) -> int:
    """Play a checkpoint and print how it did."""
    if not 1 <= command.episodes <= 10_000:
        raise ConfigError("--episodes", command.episodes, "take 1 to 10_000")
    if command.flicker is not None and not 0.0 <= command.flicker <= 1.0:
        raise ConfigError("--flicker", command.flicker, "take a probability from 0 to 1")
    folder = RunFolder(command.run)
    config = folder.config()
    played = evaluate_checkpoint(folder, config, command.checkpoint, command.episodes, command.flicker)
    if command.json:
        Console().print(json.dumps(played), soft_wrap=True, highlight=False, markup=False)
        return 0
    mean, deviation = played["eval_return_mean"], played["eval_return_std"]
    text = f"{config.env.id}: return {mean:,.1f} ± {deviation:,.1f} over {played['eval_episodes']} episodes"
    Console().print(f"{text}, after {played['env_steps']:,} environment steps", highlight=False)
    return 0


def export_policy(command: options.Export) -> int:
    """Write a policy as ONNX."""
    export.export(RunFolder(command.run), command.checkpoint, command.out)
    Console().print(f"{command.out}: inputs {', '.join(export.INPUTS)}; outputs {', '.join(export.OUTPUTS)}")
    return 0


def check_env(command: options.CheckEnv) -> int:
    """Say what the agent will make of an environment."""
    if not 1 <= command.steps <= 10_000_000:
        raise ConfigError("--steps", command.steps, "take 1 to 10_000_000")
    return env_check.check(EnvConfig(command.env), command.steps, Console())


def stats(command: options.Stats) -> int:
    """Print the newest metrics of a run, and its result if it has one."""
    folder = RunFolder(command.run)
    config, console = folder.config(), Console()
    board = Board(config.env.id, config.preset, config.seed, config.total_steps, config.replay.replay_ratio)
    for record in _records(folder.metrics):
        board.take(record)
    if not board.roles:
        raise ConfigError("RUN", str(folder.path), "it has no metrics yet; train it first")
    console.print(table(board))
    result = folder.result()
    if result is not None:
        console.print_json(data=result)
    return 0


def _records(path: Path) -> list[dict[str, object]]:
    records = []
    for line in path.read_text().splitlines() if path.exists() else []:
        with suppress(ValueError):  # torn by a crash
            records.append(json.loads(line))
    return records
