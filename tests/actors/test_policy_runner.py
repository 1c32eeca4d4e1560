"""The fast policy against the agent's own modules."""

import pickle
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from safetensors.torch import save

from rmc.actors.policy_runner import PolicyRunner
from rmc.common.agent import Agent, squashed_sample
from rmc.common.agent_config import AgentConfig, HeadInput
from rmc.common.errors import MessageError
from tests.hostile import Touch, hostile_state

OBS_DIM, ACTION_DIM, ENVS = 5, 3, 4


def make_agent(config: AgentConfig, seed: int = 0, missing: int = 1) -> Agent:
    """With statistics, scales and gates away from their defaults, so that each of them shows."""
    generator = torch.Generator().manual_seed(seed)
    agent = Agent(OBS_DIM, ACTION_DIM, config, missing)
    with torch.no_grad():
        for value in agent.parameters():
            value.copy_(torch.randn(value.shape, generator=generator) * 0.3)
    if config.normalize_observations:
        agent.normalizer.mean.copy_(torch.randn(OBS_DIM, generator=generator))
        agent.normalizer.std.copy_(torch.rand(OBS_DIM, generator=generator) + 0.1)
    return agent


def make_runner(agent: Agent, envs: int = ENVS, missing: int = 1) -> PolicyRunner:
    runner = PolicyRunner(agent.obs_dim, agent.action_dim, agent.config, envs, missing)
    runner.load(save(agent.policy_weights()))
    return runner


def first_step(runner: PolicyRunner) -> tuple[Any, ...]:
    """What it is given when all environments begin."""
    action, state = runner.start()
    return np.ones((ENVS, OBS_DIM), np.float32), action, np.zeros((ENVS, 1), np.bool_), state, None


@torch.no_grad()
def reference(
    agent: Agent, observation: torch.Tensor, prev_action: torch.Tensor, missing: torch.Tensor, state: torch.Tensor,
    noise: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    normalized = agent.normalizer(observation, missing)
    hidden, last = state[:, : agent.config.hidden], state[:, agent.config.hidden :]
    if agent.config.impute_missing:
        expected = agent.next_frame(hidden, last, prev_action).clamp(-10.0, 10.0)
        expected[~last.any(1)] = 0.0  # nothing was seen yet
        normalized = torch.where(missing, expected, normalized)
    remembered = agent.memory(normalized.unsqueeze(1), missing.unsqueeze(1), prev_action.unsqueeze(1), hidden)
    mean, log_std = agent.policy(agent.features(remembered).squeeze(1))
    action = torch.tanh(mean) if noise is None else squashed_sample(mean, log_std, noise)[0]
    after = remembered.hidden.squeeze(1)
    return action, torch.cat([after, normalized], 1) if agent.config.impute_missing else after


@pytest.mark.parametrize("flags", [1, OBS_DIM])
@pytest.mark.parametrize(
    ("embedding", "head_input", "normalize", "missing_flag", "impute_missing"),
    [
        *product((0, 16), get_args(HeadInput), (False, True), (False, True), (False,)),
        *product((0, 16), get_args(HeadInput), (True,), (False, True), (True,)),
    ],
)
def test_agrees_with_the_agent(
    embedding: int, head_input: HeadInput, normalize: bool, missing_flag: bool, impute_missing: bool,
    flags: int,
) -> None:  # fmt: skip
    config = AgentConfig(
        hidden=12, embedding=embedding, heads=(9, 7), head_input=head_input,
        normalize_observations=normalize, missing_flag=missing_flag, impute_missing=impute_missing,
    )  # fmt: skip
    agent = make_agent(config, missing=flags)
    runner = make_runner(agent, missing=flags)
    rng = np.random.default_rng(0)
    prev_action, hidden = runner.start()
    assert not prev_action.any()
    assert not hidden.any()
    for step in range(30):
        observation = rng.normal(0, 8, (ENVS, OBS_DIM)).astype(np.float32)  # some are clipped
        missing = rng.random((ENVS, flags)) < 0.3
        noise = None if step % 3 == 0 else rng.standard_normal((ENVS, ACTION_DIM), np.float32)
        given = [observation, prev_action, missing, hidden]
        kept = [x.copy() for x in given]
        tensors = [torch.from_numpy(x.copy()) for x in given]
        action, new_hidden = runner.act(*given, noise)
        expected = reference(agent, *tensors, None if noise is None else torch.from_numpy(noise))
        np.testing.assert_allclose(action, expected[0], atol=1e-5)
        np.testing.assert_allclose(new_hidden, expected[1], atol=1e-5)
        for before, after in zip(kept, given, strict=True):
            np.testing.assert_array_equal(before, after)
        prev_action, hidden = action, new_hidden.copy()


@pytest.mark.parametrize("envs", [1, 32])
def test_default_sizes_agree_with_the_agent(envs: int) -> None:
    """For few environments, and for many."""
    agent = make_agent(AgentConfig(head_input="hidden+observation"))
    with torch.no_grad():
        for value in agent.parameters():
            value *= 0.1
    rng = np.random.default_rng(1)
    observation, prev_action, hidden, noise = (
        rng.uniform(-1, 1, (envs, size)).astype(np.float32) for size in (OBS_DIM, ACTION_DIM, 256, ACTION_DIM)
    )
    missing = np.zeros((envs, 1), np.bool_)
    action, new_hidden = make_runner(agent, envs).act(observation, prev_action, missing, hidden, noise)
    tensors = [torch.from_numpy(x) for x in (observation, prev_action, missing, hidden, noise)]
    expected = reference(agent, *tensors)
    np.testing.assert_allclose(action, expected[0], atol=1e-5)
    np.testing.assert_allclose(new_hidden, expected[1], atol=1e-5)


def test_full_size_with_extreme_inputs() -> None:
    """Default sizes; huge states and deviations overflow nothing (a warning would fail the test)."""
    agent = make_agent(AgentConfig())
    runner = make_runner(agent, 2)
    observation = np.array([[1e6] * OBS_DIM, [-1e6] * OBS_DIM], np.float32)
    hidden = np.full((2, 256), 1.0, np.float32)
    zeros, noise = np.zeros((2, ACTION_DIM), np.float32), np.ones((2, ACTION_DIM), np.float32)
    action, new_hidden = runner.act(observation, zeros, np.zeros((2, 1), np.bool_), hidden, noise)
    assert np.isfinite(new_hidden).all()
    assert (np.abs(action) <= 1).all()


def test_an_action_is_the_callers_to_keep() -> None:
    agent = make_agent(AgentConfig(hidden=8, embedding=8, heads=(8, 8)))
    runner = make_runner(agent)
    zeros = (np.zeros((ENVS, OBS_DIM), np.float32), *runner.start())
    first, _ = runner.act(zeros[0], zeros[1], np.zeros((ENVS, 1), np.bool_), zeros[2], None)
    kept = first.copy()
    runner.act(zeros[0] + 1, zeros[1], np.zeros((ENVS, 1), np.bool_), zeros[2], None)
    np.testing.assert_array_equal(first, kept)


def test_another_runs_weights_are_refused() -> None:
    agent = make_agent(AgentConfig(hidden=8, embedding=8, heads=(8, 8)))
    blob = save(agent.policy_weights())
    for config in (AgentConfig(hidden=9, embedding=8, heads=(8, 8)), AgentConfig(hidden=8, embedding=0, heads=(8, 8))):
        with pytest.raises(MessageError):
            PolicyRunner(OBS_DIM, ACTION_DIM, config, ENVS).load(blob)
    with pytest.raises(MessageError):
        make_runner(agent).load(blob[:-4])
    with pytest.raises(MessageError):
        make_runner(agent).load(save({"policy.net.0.weight": torch.zeros(1)}))


@pytest.mark.parametrize("written", [hostile_state, lambda mark: pickle.dumps(Touch(mark))], ids=["torch", "pickle"])
def test_weights_never_execute_code(written: Callable[[Path], bytes], tmp_path: Path) -> None:
    runner = make_runner(make_agent(AgentConfig(hidden=8, embedding=8, heads=(8, 8))))
    with pytest.raises(MessageError, match="not a policy of this run"):
        runner.load(written(tmp_path / "owned"))
    assert not (tmp_path / "owned").exists()


@pytest.mark.parametrize("spoilt", ["policy.net.4.bias", "normalizer.std", "memory.embed.0.weight", "surprise"])
def test_refused_weights_change_nothing(spoilt: str) -> None:
    config = AgentConfig(hidden=8, embedding=8, heads=(8, 8), normalize_observations=True)
    agent, others = make_agent(config), make_agent(config, seed=1).policy_weights()
    runner = make_runner(agent)
    given = first_step(runner)
    before = runner.act(*given)[0]
    with pytest.raises(MessageError):
        runner.load(save(others | {spoilt: torch.zeros(3, 7)}))
    np.testing.assert_array_equal(runner.act(*given)[0], before)


@pytest.mark.parametrize(
    ("name", "value"),
    [("memory.gru", np.nan), ("policy.net.4.bias", np.inf), ("normalizer.mean", -np.inf), ("critic", np.nan)],
)
def test_weights_that_are_not_finite_are_refused_by_name(name: str, value: float) -> None:
    config = AgentConfig(
        hidden=8, embedding=8, heads=(8, 8), normalize_observations=True, initial_priority="actor"
    )  # fmt: skip
    agent = make_agent(config)
    runner = make_runner(agent)
    given = first_step(runner)
    before = runner.act(*given)[0]
    weights = {key: tensor.clone() for key, tensor in agent.broadcast_weights().items()}
    name = next(key for key in weights if key.startswith(name))
    weights[name].view(-1)[-1] = value
    with pytest.raises(MessageError, match=f"{name} holds NaN or infinity"):
        runner.load(save(weights))
    np.testing.assert_array_equal(runner.act(*given)[0], before)
    runner.load(save(agent.broadcast_weights()))


def test_weights_of_another_precision_are_refused() -> None:
    """A float64 may be finite and yet too large for what acts."""
    agent = make_agent(AgentConfig(hidden=8, embedding=8, heads=(8, 8)))
    weights = agent.policy_weights()
    weights["policy.net.4.bias"] = torch.full_like(weights["policy.net.4.bias"], 1e300, dtype=torch.float64)
    with pytest.raises(MessageError, match=r"policy\.net\.4\.bias has torch\.float64"):
        make_runner(agent).load(save(weights))
