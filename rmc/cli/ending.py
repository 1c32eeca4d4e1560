"""What a user is told at the end of a run."""

import json
from typing import Any

from rich.console import Console

from rmc.common.checkpoint import PROGRESS, CheckpointFolder
from rmc.common.errors import RoleDied
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.state import STOPPED


def say_end(folder: RunFolder, console: Console) -> int:
    """Print how a run ended that another process trained; its exit status."""
    status, config = folder.ended(), folder.config()
    if status == 0:
        return say_result(folder, console)
    if status == STOPPED:
        newest = CheckpointFolder(folder.checkpoints).latest()
        steps = json.loads(newest[1][PROGRESS])["env_steps"] if newest else 0
        return say_stopped(folder, config, steps, console)
    log_file = folder.logs / "launcher.log"
    last_lines = log_file.read_text(errors="replace").strip().splitlines()[-30:] if log_file.exists() else []
    console.print("\n".join(last_lines), soft_wrap=True)
    raise RoleDied(f"the launcher of {folder.path} ended with status {status}; the whole of its words: {log_file}")


def format_evaluation(evaluation: dict[str, Any]) -> str:
    """Mean and deviation of the returns, and how many there are."""
    mean, deviation = evaluation["eval_return_mean"], evaluation["eval_return_std"]
    over = f"over {evaluation['eval_episodes']} deterministic episodes{cut_note(evaluation)}"
    return f"return {mean:,.1f} ± {deviation:,.1f} {over}"


def cut_note(evaluation: dict[str, Any]) -> str:
    """What to say where an evaluation was cut; empty where it was not."""
    return ", cut when its seconds were over" if evaluation.get("eval_cut") else ""


def say_stopped(folder: RunFolder, config: RunConfig, env_steps: int, console: Console) -> int:
    command = f"rmc train {config.env.id} --preset {config.preset} --seed {config.seed} --run-dir {folder.path}"
    console.print(f"stopped at environment step {env_steps:,}; to go on, give the same options and")
    console.print(f"  {command}", soft_wrap=True)
    return STOPPED


def say_result(folder: RunFolder, console: Console) -> int:
    result = folder.result()
    assert result is not None
    console.print(f"after training:  {format_evaluation(result)}")
    facts = f"{result['env_steps']:,} environment steps, {result['updates']:,} updates, {result['wall_s']:,.0f} s"
    console.print(f"{facts}; {folder.result_file}", soft_wrap=True)
    return 0
