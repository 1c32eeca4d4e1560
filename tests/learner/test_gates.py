"""How far back the memory's gates reach before anything is learnt."""

import dataclasses
from pathlib import Path

import pytest
import safetensors.torch
import torch

from rmc.analysis.evaluation import initial_policy
from rmc.common.agent import Memory, initial_agent
from rmc.common.agent_config import AgentConfig
from rmc.common.env.config import EnvConfig
from rmc.common.window import WindowSpec
from rmc.deploy.local.lockstep import Lockstep
from rmc.deploy.run.presets import debug

STEPS = 100


def reach(memory: Memory, steps: int) -> float:
    """The size of d h_T / d o_1 after so many steps of silence."""
    first = torch.ones(1, 1, 3, requires_grad=True)
    o = torch.cat([first, torch.zeros(1, steps - 1, 3)], 1)
    missing, actions = torch.zeros(1, steps, dtype=torch.bool), torch.zeros(1, steps, 2)
    hidden = memory(o, missing, actions, torch.zeros(1, 64)).hidden
    hidden[0, -1].sum().backward()
    assert first.grad is not None
    return float(first.grad.abs().sum())


def test_chrono_initialisation_holds_what_was_seen_over_a_window() -> None:
    torch.manual_seed(0)
    memory = Memory(3, 2, AgentConfig(hidden=64, embedding=16))
    before = reach(memory, STEPS)
    memory.start_gates(STEPS)
    assert reach(memory, STEPS) > 1e6 * before
    size = memory.gru.hidden_size
    bias = (memory.gru.bias_ih_l0 + memory.gru.bias_hh_l0)[size : 2 * size]
    kept = 1.0 / (1.0 - torch.sigmoid(bias.detach()))  # steps
    assert kept.min() >= 2.0
    assert kept.max() <= STEPS + 1e-3
    assert float(kept.mean()) == pytest.approx(1.0 + STEPS / 2, rel=0.2)


def test_the_policy_before_training_is_the_one_that_the_learner_starts_from(tmp_path: Path) -> None:
    config = debug(EnvConfig("Pendulum-v1"))
    config = dataclasses.replace(config, agent=dataclasses.replace(config.agent, gate_init="chrono"))
    run = Lockstep(config, tmp_path)
    ours, theirs = safetensors.torch.load(initial_policy(config)), run.learner.agent.policy_weights()
    assert {name for name, value in theirs.items() if not torch.equal(ours[name], value)} == set()
    run.close()


def test_another_seed_is_another_policy_before_training() -> None:
    config = debug(EnvConfig("InvertedPendulum-v5"))
    assert initial_policy(dataclasses.replace(config, seed=1)) != initial_policy(config)


def test_an_agent_is_made_without_a_draw_from_torchs_own_random_numbers() -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    initial_agent(WindowSpec(3, 2, 8, 4, 5), AgentConfig(hidden=8, heads=(5, 5)), seed=1)
    assert torch.equal(torch.rand(3), expected)
