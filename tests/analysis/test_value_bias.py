"""What the critics expect beside discounted rewards and entropy bonuses worked out by hand."""

import dataclasses

import numpy as np
import pytest
import torch

from rmc.analysis.episodes import Episode
from rmc.analysis.influence import ReplayedEpisode
from rmc.analysis.value_bias import value_bias
from rmc.common.agent import Agent, squashed_sample
from rmc.common.agent_config import AgentConfig

STEPS = 6


@pytest.fixture
def agent() -> Agent:
    torch.manual_seed(0)
    agent = Agent(3, 2, AgentConfig(hidden=8, embedding=8, heads=(8, 8)))
    with torch.no_grad():
        agent.log_alpha.fill_(-100.0)  # no bonus
    return agent


@pytest.fixture
def episode() -> Episode:
    rng = torch.Generator().manual_seed(1)
    observation, action = torch.randn(1, STEPS + 1, 3, generator=rng), torch.rand(1, STEPS, 2, generator=rng)
    missing, beside = torch.zeros(1, STEPS + 1, 1, dtype=torch.bool), torch.zeros(1, STEPS + 1, 0)
    rewards = torch.arange(1.0, STEPS + 1.0)
    return Episode(observation, action, rewards, missing, beside, np.zeros((STEPS + 1, 3)), {}, terminated=True)


def test_of_a_terminated_episode_all_steps_count(agent: Agent, episode: Episode) -> None:
    found = value_bias(agent, [episode], gamma=0.5)
    assert found is not None
    returns = [sum(0.5**k * (t + k) for k in range(STEPS - t + 1)) for t in range(1, STEPS + 1)]
    assert found.steps == STEPS
    assert found.came == pytest.approx(np.mean(returns), rel=1e-5)
    with torch.no_grad():
        assert found.expected == pytest.approx(ReplayedEpisode(agent, episode).outputs[1].mean().item(), rel=1e-5)


def test_both_are_told_as_the_environment_gives_rewards(agent: Agent, episode: Episode) -> None:
    scaled, told = (value_bias(agent, [episode], gamma=0.5, reward_scale=scale) for scale in (1.0, 0.01))
    assert scaled is not None
    assert told is not None
    assert (told.expected, told.came) == pytest.approx((100.0 * scaled.expected, 100.0 * scaled.came))


def test_of_one_that_was_cut_the_last_steps_are_left_out(agent: Agent, episode: Episode) -> None:
    cut = dataclasses.replace(episode, terminated=False)
    assert value_bias(agent, [cut], gamma=0.99) is value_bias(agent, [cut], gamma=1.0) is None
    found = value_bias(agent, [cut, episode], gamma=0.4)
    assert found is not None
    assert found.steps == STEPS - 5 + STEPS


def test_entropy_counts_from_the_next_step_on(agent: Agent, episode: Episode) -> None:
    without = value_bias(agent, [episode], gamma=0.5)
    with torch.no_grad():
        agent.log_alpha.fill_(0.0)
        agent.policy.net[-1].bias[2:] = -3.0  # narrow: log pi is large, the bonus negative
    narrow = value_bias(agent, [episode], gamma=0.5)
    assert without is not None
    assert narrow is not None
    assert narrow.came < without.came - 1.0
    assert value_bias(agent, [episode], gamma=0.0).came == pytest.approx(3.5)  # type: ignore[union-attr]


@pytest.mark.parametrize(("terminated", "known"), [(True, STEPS), (False, STEPS - 4)])
def test_returns_and_bonuses_are_those_of_a_plain_loop(
    agent: Agent, episode: Episode, terminated: bool, known: int
) -> None:
    """To a cut's last step belongs what the critics expect; a step's bonus counts in the return of the one before."""
    gamma, episode = 0.25, dataclasses.replace(episode, terminated=terminated)
    with torch.no_grad():
        agent.log_alpha.fill_(0.5)
        replay = ReplayedEpisode(agent, episode)
        noise = torch.randn(1, STEPS, 2, generator=torch.Generator().manual_seed(0))
        log_pi = squashed_sample(*agent.policy(replay.features), noise)[1][0].tolist()
        q = replay.outputs[1][0, :, 0].tolist()
    came = [float(episode.reward[-1]) if terminated else q[-1]]
    for t in range(STEPS - 2, -1, -1):
        came.insert(0, float(episode.reward[t]) + gamma * (came[0] - np.exp(0.5) * log_pi[t + 1]))
    found = value_bias(agent, [episode], gamma)
    assert found is not None
    assert found.steps == known
    assert found.came == pytest.approx(np.mean(came[:known]), rel=1e-4)
    assert found.expected == pytest.approx(np.mean(q[:known]), rel=1e-4)
