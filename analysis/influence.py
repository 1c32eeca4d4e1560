"""What a changed observation still changes k steps later: in h, in Q of the action taken, in the policy's mean action.

Each dimension is changed alone, by one standard deviation; what follows it is replayed as it was recorded. Differences
are relative to each quantity's own spread over all steps: 1 is as much as it varies by itself.
Shapes: T steps of an episode, O observation, A action, S state, H hidden, M flags of what is missing,
D changed dimensions, K delays.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rmc.analysis.episodes import Episode, unroll_episode
from rmc.common.agent import Agent, MemoryOutput
from rmc.common.critic import critic_input
from rmc.common.window import Doubles

QUANTITIES = ("h", "Q", "action")
DELAYS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100, 150, 200, 300, 500, 700, 1_000)
EPISODES = 8  # in which observations are changed
LATER = 4  # observations changed in each of them, beside the first
CHANGED = 32  # dimensions at most: those that change h the most at once
REACHED = 0.5  # share of the starts after which so many steps must be left


@dataclass(frozen=True)
class Influence:
    """By delay, medians over starts, each of the dimension that changes the most."""

    delays: tuple[int, ...]  # K
    changes: dict[str, Doubles]  # (K,) of each quantity


class ReplayedEpisode:
    """A recorded episode, and what the agent makes of it if one observation were another."""

    def __init__(self, agent: Agent, episode: Episode) -> None:
        self._agent, self._episode, self.steps = agent, episode, episode.action.shape[1]
        memory, seen = unroll_episode(agent, episode)
        before_actions = MemoryOutput(*(part[:, :-1] for part in memory))
        self.features = agent.features(before_actions)  # (1, T, Z), what the heads read
        self.outputs = self._outputs(before_actions, torch.arange(self.steps))
        frames = seen[0] if agent.config.impute_missing else seen[0, :, :0]
        self._states = torch.cat([memory.hidden[0], frames], 1)  # (T + 1, S) after each observation

    @property
    def observations(self) -> Tensor:
        """(T, O) from which steps were taken, normalised."""
        return self._episode.observation[0, :-1]

    @property
    def missing(self) -> Tensor:
        """(T, M) bool, what of them nobody reads."""
        return self._episode.missing[0, :-1]

    def differences(self, start: int, change: Tensor, delays: Tensor) -> list[Tensor]:
        """Of h, Q and the mean action, (D, K, ·) each, with (D, O) added to the observation at ``start``."""
        end = start + int(delays[-1]) + 1
        later = slice(start, end)
        rows, episode = len(change), self._episode
        observation = episode.observation[:, later].repeat(rows, 1, 1)
        observation[:, 0] += change
        missing, previous = (x[:, later].repeat(rows, *[1] * (x.ndim - 1)) for x in (episode.missing, episode.previous))
        state = self._states[start - 1] if start else torch.zeros_like(self._states[0])
        memory, _, _ = self._agent.unroll(observation, missing, previous, state.repeat(rows, 1))
        at = MemoryOutput(memory.hidden[:, delays], memory.skip[:, delays])
        changed = self._outputs(at, start + delays)
        return [new - old[:, start + delays] for new, old in zip(changed, self.outputs, strict=True)]

    def _outputs(self, memory: MemoryOutput, steps: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """h (B, K, H), Q of the actions taken (B, K, 1) and the mean action (B, K, A) at those steps (K,)."""
        features = self._agent.features(memory)
        taken = self._episode.action[:, steps].expand(len(features), -1, -1)
        beside = self._episode.privileged[:, steps].expand(len(features), -1, -1)
        q = self._agent.critic(critic_input(features, beside), taken).mean(0).unsqueeze(-1)
        return memory.hidden, q, torch.tanh(self._agent.policy(features)[0])


@torch.no_grad()
def influence(agent: Agent, episodes: list[Episode]) -> tuple[Influence, Influence]:
    """Of the episodes' first observations, by their deviation from episode to episode; and of later ones, by all's."""
    replays = [ReplayedEpisode(agent, episode) for episode in episodes[:EPISODES]]
    spreads = [
        _spread(torch.cat([part[0] for part in parts])) for parts in zip(*(r.outputs for r in replays), strict=True)
    ]
    first = [(replay, 0) for replay in replays]
    later = [(replay, max(1, replay.steps * i // (LATER + 1))) for replay in replays for i in range(1, LATER + 1)]
    return (
        _of_starts(first, _deviation(replays, slice(1)), spreads),
        _of_starts(later, _deviation(replays, slice(None)), spreads),
    )


def _deviation(replays: list[ReplayedEpisode], steps: slice) -> Tensor:
    """(O,) of what was seen at those steps of all episodes."""
    values = torch.cat([replay.observations[steps] for replay in replays])
    seen = torch.cat([~replay.missing[steps] for replay in replays]).expand_as(values)
    count = seen.sum(0).clamp(min=1)
    mean = (values * seen).sum(0) / count
    return ((((values - mean) * seen).square()).sum(0) / count).sqrt()


def _spread(values: Tensor) -> Tensor:
    """(N, ·) -> root of the summed variances."""
    return values.var(0).sum().sqrt()


def _of_starts(starts: list[tuple[ReplayedEpisode, int]], deviation: Tensor, spreads: list[Tensor]) -> Influence:
    """``deviation`` (O,) is what each dimension is changed by."""
    starts = [(one, start) for one, start in starts if start + 1 < one.steps and not one.missing[start].all()]
    left = np.array([replay.steps - 1 - start for replay, start in starts])
    delays = tuple(k for k in DELAYS if len(left) and (left >= k).mean() >= REACHED)
    if not delays:
        return Influence((), {name: np.zeros(0) for name in QUANTITIES})
    values = zip(*(_of_start(*one, deviation, spreads, delays) for one in starts), strict=True)
    return Influence(delays, {name: np.nanmedian(each, axis=0) for name, each in zip(QUANTITIES, values, strict=True)})


def _of_start(
    replay: ReplayedEpisode, start: int, deviation: Tensor, spreads: list[Tensor], delays: tuple[int, ...]
) -> list[Doubles]:
    """(K,) for each quantity, of its most changed dimension; NaN where the episode is over."""
    change = _changes(replay, start, deviation)
    inside = torch.tensor([k for k in delays if start + k < replay.steps])
    rows = []
    for difference, spread in zip(replay.differences(start, change, inside), spreads, strict=True):
        sizes = (difference.norm(dim=-1) / spread.clamp(min=1e-9)).max(0).values
        rows.append(np.pad(sizes.double().numpy(), (0, len(delays) - len(inside)), constant_values=np.nan))
    return rows


def _changes(replay: ReplayedEpisode, start: int, deviation: Tensor) -> Tensor:
    """(D, O), one dimension each, towards zero, so that normalised it stays within its clip; what is missing stays."""
    deviation = deviation.where(~replay.missing[start].expand_as(deviation), 0.0)
    change = torch.diag(torch.where(replay.observations[start] > 0, -deviation, deviation))
    if len(change) <= CHANGED:
        return change
    at_once = replay.differences(start, change, torch.tensor([0]))[0].norm(dim=-1)[:, 0]
    return change[at_once.topk(CHANGED).indices]
