"""What each command does that takes a policy, or trains a baseline: all import torch."""

import dataclasses
import json
from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from rmc.analysis import export, memory_picture, video, world_model_picture
from rmc.analysis.evaluation import EvaluationProgress
from rmc.analysis.out_file import check_writable
from rmc.analysis.policy import Policy
from rmc.analysis.policy_file import PolicyFile, read_policy
from rmc.analysis.run_evaluation import MOST_EPISODES, check_baselines, evaluate_run, is_baseline
from rmc.cli import run_options
from rmc.cli.ending import cut_note, episode_count
from rmc.cli.signals import signals_caught
from rmc.common.env.config import RANGES, check_range
from rmc.common.errors import STOPPED_STATUS, ConfigError
from rmc.common.process.redirect import redirected
from rmc.common.return_text import return_text
from rmc.common.whole_file import write_whole
from rmc.deploy.monitor.view import terminal


def evaluate(command: run_options.Evaluate) -> int:
    check_range("--episodes", command.episodes, (1, MOST_EPISODES))
    if not command.seconds >= 0.0:
        raise ConfigError("--seconds", command.seconds, "take 0 or more")
    for flicker in command.flicker:
        check_range("--flicker", flicker, (0.0, 1.0))
    if command.env_timeout is not None:
        check_range("--env-timeout", command.env_timeout, RANGES["env_timeout"])
    aside = partial(redirected, {1: 2}) if command.json else nullcontext  # what a user's module prints
    with aside():
        policy = _policy(command)
        if policy is not None and command.video is not None:
            video.prepare(policy.header.env, command.video)
    console = Console(stderr=True, markup=False, emoji=False, highlight=False)
    watch = EvaluationProgress(console, str(command.run), keeps=True)
    for probability in command.flicker or (None,):
        with aside():
            played = evaluate_run(
                policy or command.run, command.episodes, command.checkpoint, probability, command.seconds, watch,
                command.env_timeout,
            )  # fmt: skip
        words = json.dumps(played) if command.json else _result_line(played, watch.stopped)
        terminal().print(words, soft_wrap=True)
        if watch.stopped:
            return STOPPED_STATUS
    if policy is not None and command.video is not None:
        with aside():
            _film(command, policy, command.video)
    return 0


def _policy(command: run_options.Evaluate) -> PolicyFile | None:
    """Read once, as a run in training goes on to others; None of a baseline's run."""
    if is_baseline(command.run):
        if command.video is not None:
            raise ConfigError("--video", str(command.video), "only runs of rmc train are filmed; leave it")
        return None
    policy = read_policy(command.run, command.checkpoint)
    return policy if command.env_timeout is None else policy.with_timeout(command.env_timeout)


def _film(command: run_options.Evaluate, policy: PolicyFile, file: Path) -> None:
    env = policy.header.env
    env = dataclasses.replace(env, flicker=command.flicker[0]) if command.flicker else env
    total = video.record(Policy(policy), env, policy.header.seed, file)
    if not command.json:
        terminal().print(f"{file}: an episode with return {return_text(total)}", soft_wrap=True)


def _result_line(played: dict[str, Any], stopped: bool) -> str:
    returns = return_text(played["eval_return_mean"], played["eval_return_std"])
    shares = {"frames": played["eval_flicker"], "sensors": played["eval_drop_sensors"]}
    missing = " and ".join(f"{share:.0%} of the {name}" for name, share in shares.items() if share)
    env = f"{played['env']} with {missing} missing" if missing else played["env"]
    text = f"{env}: return {returns} over {episode_count(played['eval_episodes'])}"
    return f"{text}{', cut when it was stopped' if stopped else cut_note(played)}, after {played['env_steps']:,} steps"


def export_policy(command: run_options.Export) -> int:
    check_writable("--out", command.out, (".onnx", ".safetensors"))
    policy, console = read_policy(command.run, command.checkpoint), terminal()
    if command.out.suffix.lower() == ".safetensors":
        write_whole(command.out, policy.encode())
        console.print(f"{command.out}: {policy.header.summary()}", soft_wrap=True)
        return 0
    export.export(policy, command.out)
    summary = f"{command.out}: inputs {', '.join(export.INPUTS)}; outputs {', '.join(export.OUTPUTS)}"
    console.print(summary, soft_wrap=True)
    return 0


def inspect(command: run_options.Inspect) -> int:
    console = terminal(max(terminal().width, memory_picture.WIDTH))
    insight, memory, value = world_model_picture.inspect(command.run, command.checkpoint, command.out)
    console.print(*_unexplained(insight), sep="\n", soft_wrap=True)
    if value is None:
        needed = "--n-step 1, and episodes that terminate or outlast 3 / (1 - gamma) steps"
        console.print(f"critics are not compared with returns: that takes {needed}", soft_wrap=True)
    else:
        counted = f"with the entropy's bonus, without curiosity, over {value.steps:,} steps"
        expected, came = return_text(value.expected), return_text(value.came)
        console.print(f"critics expect {expected} on average; {came} came, {counted}", soft_wrap=True)
    console.print(*memory_picture.tables(memory), sep="\n")
    console.print(f"{command.out}", soft_wrap=True)
    return 0


def _unexplained(insight: world_model_picture.Insight) -> Iterator[str]:
    """What the world model leaves unexplained, in lines; that nothing was seen would read as a perfect prediction."""
    ahead = ", ".join(f"{share:.0%} {horizon} ahead" for horizon, share in insight.open_loop.items())
    if ahead:
        yield f"unexplained of the observation's change: {ahead} (100% is a guess of no change)"
    if 1 not in insight.open_loop:
        yield world_model_picture.NOTHING_SEEN
        return
    hardest = np.argsort(-insight.unexplained)[: world_model_picture.SHOWN]
    worst = ", ".join(f"{i} ({insight.unexplained[i]:.0%})" for i in hardest)
    yield f"worst dimensions one step ahead: {worst}"


def baseline(command: run_options.Baseline) -> int:
    check_baselines(command.algorithm)
    from rmc.analysis import baselines  # an extra, and slow to import

    with signals_caught() as stop:
        return baselines.train(command.config(), command.run_dir, terminal(), stop)
