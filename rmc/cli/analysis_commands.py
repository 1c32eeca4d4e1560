"""What each command does that looks at a run or an environment."""

import dataclasses
import importlib.util
import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from rmc.analysis import curves, env_check, export, history, video, world_model_picture
from rmc.analysis.evaluation import Progress, evaluate_checkpoint
from rmc.analysis.policy import load_policy
from rmc.analysis.run_paths import expanded
from rmc.cli import run_options
from rmc.cli.ending import cut_note
from rmc.cli.signals import signals_caught
from rmc.common.errors import ConfigError
from rmc.common.extra import how_to_install
from rmc.deploy.monitor.view import terminal
from rmc.deploy.run.folder import RunFolder

log = logging.getLogger(__name__)


def evaluate(command: run_options.Evaluate) -> int:
    """Play a checkpoint and print how it did."""
    if not 1 <= command.episodes <= 10_000:
        raise ConfigError("--episodes", command.episodes, "take 1 to 10_000")
    if not command.seconds >= 0.0:
        raise ConfigError("--seconds", command.seconds, "take 0 or more")
    for flicker in command.flicker:
        if not 0.0 <= flicker <= 1.0:
            raise ConfigError("--flicker", flicker, "take probabilities from 0 to 1")
    folder, console = RunFolder(command.run), terminal()
    if command.video is not None and folder.is_baseline():
        raise ConfigError("--video", str(command.video), "only runs of rmc train are filmed; leave it")
    if command.video is not None:
        video.prepare(folder.config().env, command.video)
    for probability in command.flicker or (None,):
        played = _played(folder, command, probability)
        text = json.dumps(played) if command.json else _said(played)
        console.print(text, soft_wrap=True)
    if command.video is not None:
        policy, config = load_policy(command.run, command.checkpoint), folder.config()
        env = dataclasses.replace(config.env, flicker=command.flicker[0]) if command.flicker else config.env
        total = video.record(policy, env, config.seed, command.video)
        if not command.json:
            console.print(f"{command.video}: an episode with return {total:,.1f}", soft_wrap=True)
    return 0


def _played(folder: RunFolder, command: run_options.Evaluate, flicker: float | None) -> dict[str, Any]:
    watch = Progress(Console(stderr=True), str(command.run))
    if not folder.is_baseline():
        return evaluate_checkpoint(
            folder, folder.config(), command.checkpoint, command.episodes, flicker, command.seconds, watch
        )
    if command.checkpoint != "latest":
        raise ConfigError("--checkpoint", command.checkpoint, "a baseline keeps its last state only; use latest")
    _check_baselines(str(folder.path))
    from rmc.analysis import baselines

    return baselines.evaluate(folder, command.episodes, flicker, command.seconds, watch)


def _check_baselines(what: str) -> None:
    for package in ("stable_baselines3", "sb3_contrib"):
        if importlib.util.find_spec(package) is None:
            raise ConfigError("baseline", what, f"{package} is missing; {how_to_install('baselines')}")


def _said(played: dict[str, Any]) -> str:
    mean, deviation, flicker = (played[f"eval_{name}"] for name in ("return_mean", "return_std", "flicker"))
    seen = f" with {flicker:.0%} of the frames missing" if flicker else ""
    text = f"{played['env']}{seen}: return {mean:,.1f} ± {deviation:,.1f} over {played['eval_episodes']} episodes"
    return f"{text}{cut_note(played)}, after {played['env_steps']:,} environment steps"


def export_policy(command: run_options.Export) -> int:
    """Write a policy as ONNX."""
    export.export(RunFolder(command.run), command.checkpoint, command.out)
    terminal().print(f"{command.out}: inputs {', '.join(export.INPUTS)}; outputs {', '.join(export.OUTPUTS)}")
    return 0


def inspect(command: run_options.Inspect) -> int:
    """Write a picture of what the world model knows, and say it in numbers."""
    found, console = world_model_picture.inspect(command.run, command.checkpoint, command.out), terminal()
    ahead = ", ".join(f"{share:.0%} {horizon} ahead" for horizon, share in found.open_loop.items())
    hardest = np.argsort(-found.unexplained)[: world_model_picture.SHOWN]
    worst = ", ".join(f"{i} ({found.unexplained[i]:.0%})" for i in hardest)
    console.print(
        f"unexplained of the observation's change: {ahead} (100% is a guess of no change)",
        soft_wrap=True,
    )
    console.print(f"worst dimensions one step ahead: {worst}")
    console.print(f"{command.out}", soft_wrap=True)
    return 0


def check_env(command: run_options.CheckEnv) -> int:
    """Say what the agent will make of an environment."""
    if not 1 <= command.steps <= 10_000_000:
        raise ConfigError("--steps", command.steps, "take 1 to 10_000_000")
    return env_check.check(command.env.config(), command.steps, terminal())


def baseline(command: run_options.Baseline) -> int:
    """Train an agent of stable-baselines3."""
    _check_baselines(command.algorithm)
    from rmc.analysis import baselines  # an extra, and slow to import

    with signals_caught() as stop:
        return baselines.train(command.config(), command.run_dir, terminal(), stop)


def plot(command: run_options.Plot) -> int:
    """Draw curves and print their table."""
    if not command.runs:
        raise ConfigError("RUNS", "", "give folders of runs, or files of JSON lines")
    groups, console = curves.grouped(_histories(command.runs)), terminal(max(terminal().width, curves.WIDTH))
    console.print(*curves.tables(groups, command.reference), sep="\n")
    curves.draw(groups, command.by, command.out)
    console.print(f"{command.out}", soft_wrap=True)
    return 0


def _histories(paths: Sequence[Path]) -> list[history.History]:
    """Of all that can be read; the others are told. Raises ConfigError where that is none."""
    runs = list(dict.fromkeys(run for path in paths for run in expanded(path)))
    found = []
    for run in runs:
        try:
            found += history.read(run)
        except ConfigError as error:
            if len(runs) == 1:
                raise
            log.warning("%s (left out)", error)
    if not found:
        raise ConfigError("RUNS", " ".join(map(str, paths)), "no history in there; give runs that were evaluated")
    return found
