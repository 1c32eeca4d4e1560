"""What the critics expect beside what came: too much of it, and the policy maximises errors.

Shapes: T steps of an episode.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rmc.analysis.episodes import Episode
from rmc.analysis.influence import ReplayedEpisode
from rmc.common.agent import Agent, squashed_sample

HORIZONS = 3.0  # of 1 / (1 - gamma) steps, left out at a cut: 5 % of a return is then the critics' own guess


@dataclass(frozen=True)
class ValueBias:
    """Means over steps of the agent's own episodes, in the environment's rewards."""

    expected: float  # Q of the action taken, mean of both critics
    came: float  # discounted rewards and entropy bonuses, as Q counts them
    steps: int


@torch.no_grad()
def value_bias(agent: Agent, episodes: list[Episode], gamma: float, reward_scale: float = 1.0) -> ValueBias | None:
    """Of all steps whose return is known; None where there is none. Curiosity is not counted."""
    expected, came = [], []
    for episode in episodes:
        replay = ReplayedEpisode(agent, episode)
        q = replay.outputs[1][0, :, 0]
        unknown = 0.0 if episode.terminated else HORIZONS / (1.0 - gamma) if gamma < 1.0 else math.inf
        known = max(0, len(q) - round(min(unknown, len(q))))
        returns = _soft_returns(episode, _bonus(agent, replay.features), q[-1], gamma)
        expected.append(q[:known])
        came.append(returns[:known])
    steps = sum(map(len, expected))
    if not steps:
        return None
    mean_q, mean_return = (float(torch.cat(values).mean()) / reward_scale for values in (expected, came))
    return ValueBias(mean_q, mean_return, steps)


def _bonus(agent: Agent, features: Tensor) -> Tensor:
    """(1, T, Z) -> (T,) -alpha log pi of one sample of each step."""
    mean, log_std = agent.policy(features)
    noise = torch.randn(mean.shape, generator=torch.Generator().manual_seed(0))
    return -agent.log_alpha.exp() * squashed_sample(mean, log_std, noise)[1][0]


def _soft_returns(episode: Episode, bonus: Tensor, last_q: Tensor, gamma: float) -> Tensor:
    """(T,) G_t = r_t + gamma (G_{t+1} - alpha log pi_{t+1}); at a cut, the last is what the critics expect."""
    rewards = episode.reward.tolist()
    after = rewards[-1] if episode.terminated else float(last_q)
    returns = [after]
    for reward, entropy in zip(rewards[-2::-1], bonus.tolist()[:0:-1], strict=True):
        after = reward + gamma * (after + entropy)
        returns.append(after)
    return torch.tensor(returns[::-1])
