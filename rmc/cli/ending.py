"""What a user is told at the end of a run."""

from typing import Any

from rich.console import Console

from rmc.analysis.doctor import examine
from rmc.common.errors import STOPPED_STATUS, RoleDied
from rmc.common.return_text import return_text
from rmc.deploy.local.launcher import saved_steps
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.metrics_tail import MetricsTail
from rmc.deploy.run.starts import resume_command


def print_end(folder: RunFolder, console: Console) -> int:
    """Print how a run ended that another process trained; its exit status."""
    status = folder.lock.ended()
    if status == 0:
        return print_result(folder, console)
    if status == STOPPED_STATUS:
        return print_stopped(folder, saved_steps(folder), console)
    if status is None:
        raise RoleDied(f"the launcher of {folder.path} was killed; to go on: {resume_command(folder)}")
    log_file = folder.logs / "launcher.log"
    last_lines = log_file.read_text(errors="replace").strip().splitlines()[-30:] if log_file.exists() else []
    for line in last_lines:  # of a stranger's run, perhaps
        console.print(line if line.isprintable() else ascii(line), soft_wrap=True)
    raise RoleDied(f"the launcher of {folder.path} ended with status {status}; the whole of its words: {log_file}")


def format_evaluation(evaluation: dict[str, Any]) -> str:
    """Mean and deviation of the returns, and how many there are."""
    over = f"over {episode_count(evaluation['eval_episodes'], 'deterministic ')}{cut_note(evaluation)}"
    return f"return {return_text(evaluation['eval_return_mean'], evaluation['eval_return_std'])} {over}"


def episode_count(count: int, kind: str = "") -> str:
    """So many, in words."""
    return f"{count:,} {kind}episode{'s' * (count != 1)}"


def cut_note(evaluation: dict[str, Any]) -> str:
    """What to say where an evaluation was cut; empty where it was not."""
    return ", cut when its seconds were over" if evaluation.get("eval_cut") else ""


def print_stopped(folder: RunFolder, env_steps: int, console: Console) -> int:
    """Print how to go on; the exit status."""
    console.print(f"stopped at step {env_steps:,}; to go on:")
    console.print(f"  {resume_command(folder)}", soft_wrap=True)
    print_findings(folder, console)
    return STOPPED_STATUS


def print_result(folder: RunFolder, console: Console) -> int:
    result = folder.result()
    assert result is not None
    console.print(f"after training:  {format_evaluation(result)}")
    facts = f"{result['env_steps']:,} steps, {result['updates']:,} updates, {result['wall_s']:,.0f} s"
    console.print(f"{facts}; {folder.result_file}", soft_wrap=True)
    print_findings(folder, console)
    return 0


def print_findings(folder: RunFolder, console: Console) -> None:
    """What ``rmc doctor`` would say; nothing of a run that was too short to judge."""
    for finding in examine(MetricsTail(folder.metrics).take(), folder.config()):  # a long run's would fill the memory
        console.print(str(finding), soft_wrap=True)
