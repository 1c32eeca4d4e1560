"""Who is told how far back a memory can learn, and with which options."""

from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import pytest

from rmc.common.agent_config import AgentConfig
from rmc.common.env.config import EnvConfig
from rmc.deploy.run.config import RunConfig, WindowConfig
from rmc.deploy.run.memory_reach import format_reach, reach_note
from rmc.deploy.run.presets import robust
from tests.memory_env import MemoryEnv

gym.register("Reach-v0", MemoryEnv, kwargs={"delay": 12}, max_episode_steps=100)
OWN = "tests.deploy.test_memory_reach:Reach-v0"


def run(env_id: str = OWN, trained_steps: int = 15, strategy: Any = "burn-in", **env: Any) -> RunConfig:
    config = robust(EnvConfig(env_id, **env))
    actor = replace(config.actor, state_strategy=strategy)
    return replace(config, window=WindowConfig(trained_steps=trained_steps), actor=actor)


def test_the_line_names_both_lengths_and_the_options() -> None:
    assert format_reach(15, 1_000) == (
        "the memory cannot learn of anything older than 15 steps; episodes last up to 1,000 "
        "(--trained-steps, or --state-strategy episode)"
    )
    assert format_reach(15, None) == (
        "the memory cannot learn of anything older than 15 steps; episodes have no known time limit "
        "(--trained-steps, or --time-limit and --state-strategy episode)"
    )
    assert format_reach(100, 100) == "the memory can learn over whole episodes, of up to 100 steps"


@pytest.mark.parametrize(
    "config",
    [
        run(),
        run(time_limit=40),
        run("Pendulum-v1", flicker=0.5),
        run("Pendulum-v1", noise=0.1),
        run("Pendulum-v1", drop_sensors=0.1),
        *([run("pybullet/AntPositions-v0")] if find_spec("pybullet_envs_gymnasium") else []),
        run("Pendulum-v1", delay=2),
        run("HalfCheetah-v5", hide="velocities"),
        run(trained_steps=99),
    ],
    ids=str,
)
def test_where_something_may_be_hidden_for_longer_a_run_says_so(config: RunConfig) -> None:
    assert reach_note(config) == format_reach(config.window.trained_steps, config.layout.time_limit)


@pytest.mark.parametrize(
    "config",
    [
        run("HalfCheetah-v5"),
        run("Pendulum-v1"),
        run(trained_steps=100),
        run(strategy="episode"),
        run(time_limit=15),
        replace(run(), agent=AgentConfig(head_input="observation")),
    ],
    ids=["MuJoCo", "classic", "long windows", "whole episodes", "short episodes", "no memory"],
)
def test_elsewhere_a_run_is_silent(config: RunConfig) -> None:
    assert reach_note(config) is None
