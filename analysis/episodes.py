"""Episodes of an agent as its actors play: what it saw, and what was there but hidden from it.

Shapes: T steps of an episode, O observation, A action, F numbers of the environment's own observation, M flags of what
is missing, P privileged numbers, S state.
"""

import dataclasses
from dataclasses import dataclass
from math import isfinite
from numbers import Real
from typing import Any

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from rmc.actors.evaluator import LONGEST_EPISODE, first_start
from rmc.analysis.policy import Policy
from rmc.analysis.policy_file import PolicyFile
from rmc.common.agent import Agent, MemoryOutput
from rmc.common.env.config import EnvConfig
from rmc.common.env.describe import layout_of, visible_slice
from rmc.common.env.layout import Part
from rmc.common.env.make import make_env
from rmc.common.env.wrappers import CorruptObservation, Delay, Env, FrameStack, ObservationSlice, SeenWrapper
from rmc.common.errors import ConfigError
from rmc.common.window import Doubles, Floats
from rmc.deploy.run.config import RunConfig

LEAST_EPISODES, MOST_EPISODES = 8, 64  # played to learn about the memory: so many, and until
ENOUGH_STEPS = 4_000  # are played
LONGEST_FURTHER = 1_000  # steps of all but the first episode


@dataclass(frozen=True)
class Episode:
    """What was played, as tensors with a batch of one."""

    observation: Tensor  # (1, T + 1, O) normalised
    action: Tensor  # (1, T, A)
    reward: Tensor  # (T,), scaled as for training
    missing: Tensor  # (1, T + 1, M) bool
    privileged: Tensor  # (1, T + 1, P) normalised, what critics read beside
    own: Floats  # (T + 1, F), the environment's own observations
    probe: dict[str, Doubles]  # by name (T + 1,), of info["probe"]
    terminated: bool = False  # not cut

    @property
    def seen(self) -> Tensor:
        """(T, M) bool: missing neither in the step's frame nor in the next one."""
        return ~(self.missing[0, 1:] | self.missing[0, :-1])

    @property
    def previous(self) -> Tensor:
        """(1, T + 1, A), the action before each observation."""
        return torch.cat([torch.zeros_like(self.action[:, :1]), self.action], 1)


@dataclass(frozen=True)
class HiddenPart:
    """Numbers of the environment's own observation that the agent is not shown, or not at each step."""

    name: str
    columns: slice
    only_missing: bool  # hidden where it is missing alone
    flags: slice  # its own, where each number of what is seen has one


class RecordFrames(SeenWrapper):
    """Keeps the newest observation of the environment that it wraps."""

    newest: Floats  # (F,), NaN where the environment itself calls it missing

    def seen(self, observation: Floats, info: dict[str, Any]) -> tuple[Floats, dict[str, Any]]:
        self.newest = np.where(info.get("missing", False), np.float32(np.nan), observation)
        return observation, info


def recorded(env: Env) -> tuple[Env, RecordFrames]:
    """The environment with RecordFrames below all that hides, disturbs or stacks what is seen, and that wrapper."""
    above, inner = None, env
    while isinstance(inner, ObservationSlice | CorruptObservation | Delay | FrameStack):
        above, inner = inner, inner.env
    record = RecordFrames(inner)
    if above is None:
        return record, record
    above.env = record
    return env, record


def hidden_parts(env: Env, config: EnvConfig) -> list[HiddenPart]:
    """What of the environment's own observation options take away, and when."""
    whole = layout_of(
        env, dataclasses.replace(config, hide="nothing", frame_stack=1), {}, privileged=False
    ).observations
    first, last, _ = (visible_slice(env, config.hide) or slice(None)).indices(whole[-1].stop)
    never_as_it_is, partly_missing = bool(config.noise or config.delay), bool(config.flicker or config.drop_sensors)
    parts = []
    for part in whole:
        is_shown = first <= part.start and part.stop <= last
        only_missing = is_shown and not never_as_it_is and config.frame_stack == 1
        if not is_shown or never_as_it_is or partly_missing:
            columns, flags = slice(part.start, part.stop), slice(part.start - first, part.stop - first)
            parts.append(HiddenPart(_name(part, only_missing), columns, only_missing, flags))
    return parts


def _name(part: Part, only_missing: bool) -> str:
    name = part.name or "observation"
    return f"{name}, where missing" if only_missing else name


class Player:
    """An agent's episodes with the policy's noise, which its Q is of; the first starts from the run's seed."""

    def __init__(self, agent: Agent, config: RunConfig) -> None:
        """Raises ConfigError."""
        self._agent, self._config = agent, config
        self._policy = Policy(PolicyFile(config.policy_header(), save(agent.policy_weights())), config.seed)
        privileged = agent.privileged_normalizer is not None
        env = make_env(config.env, privileged=True) if privileged else self._policy.make_env()
        self._env, self._record = recorded(env)
        self._played = 0

    def hidden_parts(self) -> list[HiddenPart]:
        """What options hide of the environment's own observation."""
        return hidden_parts(self._env, self._config.env)

    def several(self) -> list[Episode]:
        """As many as it takes to learn about a memory. Raises ConfigError, EnvFault."""
        episodes: list[Episode] = []
        while len(episodes) < LEAST_EPISODES or (len(episodes) < MOST_EPISODES and _steps(episodes) < ENOUGH_STEPS):
            episodes.append(self.play())
            if episodes[-1].probe.keys() != (names := episodes[0].probe.keys()):
                fix = f'its info["probe"] names {sorted(names)}, then others; return the same names in every episode'
                raise ConfigError("ENV", self._config.env.id, fix)
        return episodes

    def play(self) -> Episode:
        """The next one. Raises ConfigError, EnvFault."""
        is_first, policy, env = not self._played, self._policy, self._env
        self._played += 1
        observation, info = env.reset(seed=first_start(self._config.seed, final=True) if is_first else None)
        policy.reset()
        observations, own, infos, actions, rewards = [observation], [self._record.newest], [_kept(info)], [], []
        for _ in range(LONGEST_EPISODE if is_first else LONGEST_FURTHER):
            actions.append(policy.act(observation, info.get("missing", False), explore=True))
            observation, reward, terminated, truncated, info = env.step(actions[-1])
            observations.append(observation)
            own.append(self._record.newest)
            infos.append(_kept(info))
            rewards.append(self._config.actor.reward_scale * float(reward))
            if terminated or truncated:
                break
        episode = self._episode(np.stack(observations), np.stack(actions), rewards, infos, np.stack(own))
        return dataclasses.replace(episode, terminated=bool(terminated))

    def close(self) -> None:
        self._env.close()

    def _episode(
        self, observations: Floats, actions: Floats, rewards: list[float], infos: list[dict[str, Any]], own: Floats
    ) -> Episode:
        flags = self._policy.header.layout.missing
        missing = torch.from_numpy(np.stack([np.broadcast_to(info.get("missing", False), flags) for info in infos]))
        beside = torch.zeros(len(infos), 0)
        if self._agent.privileged_normalizer is not None:  # an environment may give it to critics that do not read it
            beside = torch.from_numpy(np.stack([info["privileged"] for info in infos]))
        return Episode(
            self._agent.normalizer(torch.from_numpy(observations), missing).unsqueeze(0),
            torch.from_numpy(actions).unsqueeze(0),
            torch.tensor(rewards),
            missing.unsqueeze(0),
            self._agent.normalized_privileged(beside).unsqueeze(0),
            own,
            _probes([info["probe"] for info in infos], self._config.env.id),
        )


def _kept(info: dict[str, Any]) -> dict[str, Any]:
    """``info`` as it is at this step: an environment may write its probe into the same dict again."""
    probe = info.get("probe", {})
    return {**info, "probe": dict(probe) if isinstance(probe, dict) else probe}


def _probes(values: list[Any], env_id: str) -> dict[str, Doubles]:
    """``info["probe"]`` of every step, by name. Raises ConfigError where it is no dict of the same finite numbers."""
    for value in values:
        is_sound = isinstance(value, dict) and value.keys() == values[0].keys()
        if not is_sound or not all(isinstance(one, Real) and isfinite(one) for one in value.values()):
            fix = f'its info["probe"] is {value!r}; return a dict of the same finite numbers from reset and every step'
            raise ConfigError("ENV", env_id, fix)
    return {name: np.array([float(value[name]) for value in values]) for name in values[0]}


def _steps(episodes: list[Episode]) -> int:
    return sum(len(episode.reward) for episode in episodes)


@torch.no_grad()
def unroll_episode(agent: Agent, episode: Episode) -> tuple[MemoryOutput, Tensor]:
    """The memory along an episode from its start, (1, T + 1, ·), and what it read, missing frames filled."""
    start = torch.zeros(1, agent.config.state_size(agent.obs_dim))
    memory, seen, _ = agent.unroll(episode.observation, episode.missing, episode.previous, start)
    return memory, seen
