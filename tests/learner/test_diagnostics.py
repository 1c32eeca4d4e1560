"""Staleness: nothing where the weights are those that acted, and a plain loop's figures where they are not."""

import dataclasses

import numpy as np
import pytest
import torch

from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.common.window import Rows, WindowSpec
from rmc.learner.diagnostics import actor_critic_metrics, measurable, staleness

SPEC = WindowSpec(obs_dim=3, action_dim=2, state=8, burn_in=4, train=5)
UNBURNED = WindowSpec(obs_dim=3, action_dim=2, state=8, burn_in=0, train=5)
AGENT = AgentConfig(hidden=8, embedding=6, heads=(7, 6), head_input="hidden+observation", normalize_observations=True)
FILLING = dataclasses.replace(AGENT, impute_missing=True)
STEPS = 32  # of the episode


def make_agent(seed: int, config: AgentConfig = AGENT) -> Agent:
    torch.manual_seed(seed)
    agent = Agent(SPEC.obs_dim, SPEC.action_dim, config)
    agent.normalizer.mean += 0.3
    return agent


@torch.no_grad()
def remembered(agent: Agent, episode: dict[str, np.ndarray], hidden: np.ndarray, start: int, stop: int) -> list:
    """(state, Q of the action taken) of every step from ``start`` on, one at a time, from the state before it."""
    states, (state, last) = [], torch.from_numpy(hidden).reshape(1, -1).tensor_split([AGENT.hidden], dim=1)
    for k in range(start, stop):
        before = episode["action"][k - 1] if k else np.zeros(SPEC.action_dim, np.float32)
        o, missing, a, previous = (
            torch.from_numpy(np.asarray(x))[None, None]
            for x in (episode["observation"][k], episode["missing"][k], episode["action"][k], before)
        )
        seen = agent.normalizer(o, missing)
        if agent.config.impute_missing and missing.all():
            seen = agent.next_frame(state, last, previous[0]).unsqueeze(1)
        step = agent.memory(seen, missing, previous, state)
        state, last = step.hidden[:, 0], seen[:, 0] if agent.config.impute_missing else last
        carried = torch.cat([state, last], 1)[0].numpy()
        states.append((carried, float(agent.critic(agent.features(step), a).mean())))
    return states


def with_state(spec: WindowSpec, config: AgentConfig) -> WindowSpec:
    return dataclasses.replace(spec, state=config.state_size(spec.obs_dim))


def play(agent: Agent, spec: WindowSpec, blanks: float = 0.2) -> tuple[dict[str, np.ndarray], Rows]:
    """An episode, and its windows with the states that ``agent`` had."""
    rng = np.random.default_rng(0)
    episode = {
        "observation": rng.normal(size=(STEPS + 1, spec.obs_dim)).astype(np.float32),
        "action": rng.uniform(-1, 1, (STEPS, spec.action_dim)).astype(np.float32),
        "missing": rng.random((STEPS + 1, spec.missing)) < blanks,
    }
    states = [np.zeros(spec.state, np.float32)]
    states += [h for h, _ in remembered(agent, episode, states[0], 0, STEPS)]
    rows = np.zeros(-(-STEPS // spec.train), spec.dtype)
    for row, block in zip(rows, range(0, STEPS, spec.train), strict=True):
        first = 0 if block >= spec.burn_in else spec.burn_in
        last = spec.burn_in + min(spec.train, STEPS - block)
        start, end = block - spec.burn_in + first, block - spec.burn_in + last
        row["episode_step"], row["first"], row["last"] = block, first, last
        row["observation"][first : last + 1] = episode["observation"][start : end + 1]
        row["missing"][first : last + 1] = episode["missing"][start : end + 1]
        row["action"][first:last] = episode["action"][start:end]
        row["state"] = states[start]
    return episode, rows


@pytest.mark.parametrize("config", [AGENT, FILLING], ids=["zeros", "filled"])
@pytest.mark.parametrize("spec", [SPEC, UNBURNED])
@pytest.mark.parametrize("blanks", [0.0, 0.2])
def test_todays_weights_find_nothing_stale(spec: WindowSpec, config: AgentConfig, blanks: float) -> None:
    agent, spec = make_agent(1, config), with_state(spec, config)
    _, rows = play(agent, spec, blanks)
    chosen = np.flatnonzero(measurable(rows, spec))
    assert chosen.tolist() == [1, 2, 3, 4, 5]  # not the first, not the short
    for window in chosen:
        measured = staleness(agent, spec, rows[: window + 1])
        assert len(measured) == (6 if spec.burn_in else 3)
        assert max(measured.values()) < 1e-5


def test_where_nothing_is_blank_the_state_is_that_of_the_step_by_step_way():
    agent, state = make_agent(1, FILLING), torch.randn(2, FILLING.state_size(SPEC.obs_dim))
    o, action = torch.randn(2, 6, SPEC.obs_dim), torch.rand(2, 6, SPEC.action_dim)
    sequence = (o, torch.zeros(2, 6, 1, dtype=torch.bool), action, state)
    with torch.no_grad():
        _, seen, after = agent.unroll(*sequence)
        torch.testing.assert_close(after, agent.impute(*sequence)[1])
    assert torch.equal(seen, o)


@pytest.mark.parametrize("config", [AGENT, FILLING], ids=["zeros", "filled"])
@pytest.mark.parametrize("window", [1, 4])
def test_as_a_plain_loop_has_it(window: int, config: AgentConfig) -> None:
    actor, today, spec = make_agent(1, config), make_agent(2, config), with_state(SPEC, config)
    episode, rows = play(actor, spec)
    start = window * SPEC.train - SPEC.burn_in
    stored = rows["state"][window]
    truth = remembered(today, episode, np.zeros(spec.state, np.float32), 0, start + SPEC.steps)
    replayed = remembered(today, episode, stored, start, start + SPEC.steps)
    q = np.array([value for _, value in truth[start:]])
    gap = np.abs(np.array([value for _, value in replayed]) - q) / np.abs(q).max()
    states = replayed[SPEC.burn_in - 1][0], truth[start + SPEC.burn_in - 1][0], truth[start - 1][0], stored
    burned, true_burned, before, h = (state[: AGENT.hidden] for state in states)
    expected = {
        "stale_state_stored": np.linalg.norm(h - before) / np.linalg.norm(before),
        "stale_state_burned": np.linalg.norm(burned - true_burned) / np.linalg.norm(true_burned),
        "stale_q_first_stored": gap[0],
        "stale_q_last_stored": gap[SPEC.train - 1],
        "stale_q_first_burned": gap[SPEC.burn_in],
        "stale_q_last_burned": gap[-1],
    }
    measured = staleness(today, spec, rows[: window + 1])
    assert measured == pytest.approx(expected, abs=1e-5)
    assert measured["stale_state_stored"] > measured["stale_state_burned"] > 0.0


def test_a_state_of_zeros_is_wholly_stale() -> None:
    agent = make_agent(1)
    _, rows = play(agent, UNBURNED)
    rows["state"] = 0.0
    assert staleness(agent, UNBURNED, rows[:3])["stale_state_stored"] == pytest.approx(1.0)


def test_what_is_said_of_values_is_of_real_steps_alone() -> None:
    m = torch.tensor([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    log_pi, td_error, i, reward, first, second = torch.randn(6, 2, 3, generator=torch.Generator().manual_seed(0))
    q, i = torch.stack([first, second]), i.abs() * m
    alpha, beta, of_losses = torch.tensor(0.2), torch.tensor(0.3), {"q_loss": torch.tensor(3.0)}
    metrics = actor_critic_metrics(of_losses, alpha, log_pi, q, td_error, i, reward, m, beta)
    said = {name: value.item() for name, value in metrics.items()}
    real = [(0, 0), (0, 1), (1, 0)]
    curious, earned = (sum(float(x[at].abs()) for at in real) for x in (i, reward))
    assert said == pytest.approx(
        {
            "q_loss": 3.0,
            "alpha": 0.2,
            "entropy": -np.mean([log_pi[at] for at in real]),
            "q_mean": np.mean([(first[at] + second[at]) / 2 for at in real]),
            "td_error": np.mean([td_error[at] for at in real]),
            "curiosity_share": 0.3 * curious / (0.3 * curious + earned),
        }
    )
