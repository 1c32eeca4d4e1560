"""What stands between an environment and the agent: one class for each thing done to what is seen.

Shapes: O observation, A action.
"""

import logging
import math
from collections import deque
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Env = gym.Env[Floats, Floats]
log = logging.getLogger(__name__)


class RescaledEnv(gym.Wrapper[Floats, Floats, Any, Any]):
    """Observations as float32; actions in [-1, 1], stretched over the environment's own bounds.

    ``info["missing"]`` says that a frame is missing; ``info["blank"]``, its old name, is understood with one warning.
    Raises ValueError where an observation is no vector of numbers of the size that its space says.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        inner = env.action_space
        assert isinstance(inner, gym.spaces.Box)
        assert env.observation_space.shape is not None
        self._low, self._high = inner.low.astype(np.float64), inner.high.astype(np.float64)
        self._half_range = (self._high - self._low) / 2
        self._plain = bool((inner.low == -1.0).all() and (inner.high == 1.0).all())
        self._bounds, self._dtype, self._shape = inner, inner.dtype, env.observation_space.shape
        self.action_space = gym.spaces.Box(-1.0, 1.0, inner.shape, np.float32)
        self.observation_space = _box(env.observation_space.shape[0])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._vector(observation), _renamed(info)

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        if not self._plain:
            stretched = self._low + (action + 1.0) * self._half_range
            action = stretched.astype(self._dtype).clip(self._bounds.low, self._bounds.high)  # rounding may pass one
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._vector(observation), float(reward), terminated, truncated, _renamed(info)

    def _vector(self, observation: Any) -> Floats:
        vector = np.array(observation, np.float32)  # a copy: some environments write into the same one again
        if vector.shape != self._shape:
            raise ValueError(f"its observation has shape {vector.shape}, its space says {self._shape}")
        return vector


def _renamed(info: dict[str, Any]) -> dict[str, Any]:
    """``info`` with the key that a missing frame had until 0.2 under today's name."""
    if "blank" not in info or "missing" in info:
        return info
    _warn_of_old_name()
    return {"missing" if name == "blank" else name: value for name, value in info.items()}


@cache
def _warn_of_old_name() -> None:
    log.warning('the environment gives info["blank"]; call it info["missing"], the old name goes in the next version')


class ObservationSlice(gym.Wrapper[Floats, Floats, Floats, Floats]):
    """Only some of the observation's dimensions."""

    def __init__(self, env: Env, shown: slice) -> None:
        super().__init__(env)
        self._shown = shown
        size = range(*shown.indices(env.observation_space.shape[0] if env.observation_space.shape else 0))
        self.observation_space = _box(len(size))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return observation[self._shown], info

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation[self._shown], float(reward), terminated, truncated, info


class CorruptObservation(gym.Wrapper[Floats, Floats, Floats, Floats]):
    """Observations that chance changes; its random numbers are the episode's seed's, apart from the environment's."""

    stream: int  # keeps the random numbers of different disturbances apart

    def __init__(self, env: Env) -> None:
        super().__init__(env)
        self._rng = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        if seed is not None:
            self._rng = np.random.default_rng([seed, self.stream])
        observation, info = self.env.reset(seed=seed, options=options)
        return self.disturb(observation, info), info

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self.disturb(observation, info), float(reward), terminated, truncated, info

    def disturb(self, observation: Floats, info: dict[str, Any]) -> Floats:
        """(O,) as it is -> (O,) as it is seen; may say so in ``info``."""
        raise NotImplementedError


class Noise(CorruptObservation):
    """Independent Gaussian noise on every dimension of every observation."""

    stream = 0x2015E

    def __init__(self, env: Env, deviation: float) -> None:
        super().__init__(env)
        self._deviation = deviation

    def disturb(self, observation: Floats, info: dict[str, Any]) -> Floats:  # noqa: ARG002 (Flicker says so in it)
        return observation + self._deviation * self._rng.standard_normal(observation.shape, np.float32)


class Flicker(CorruptObservation):
    """Whole observations become zeros, independently with probability p; ``info["missing"]`` says which."""

    stream = 0xF11C

    def __init__(self, env: Env, probability: float) -> None:
        super().__init__(env)
        self._probability = probability

    def disturb(self, observation: Floats, info: dict[str, Any]) -> Floats:
        info["missing"] = bool(self._rng.random() < self._probability)
        return np.zeros_like(observation) if info["missing"] else observation


class FrameStack(gym.Wrapper[Floats, Floats, Floats, Floats]):
    """The newest observations side by side, oldest first; the first one of an episode stands for those before it."""

    def __init__(self, env: Env, frames: int) -> None:
        super().__init__(env)
        assert env.observation_space.shape
        self._frames: deque[Floats] = deque(maxlen=frames)
        self.observation_space = _box(frames * env.observation_space.shape[0])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._frames.extend([observation] * (self._frames.maxlen or 1))
        return np.concatenate(self._frames), info | {"missing": False}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._frames.append(observation)
        return np.concatenate(self._frames), float(reward), terminated, truncated, info | {"missing": False}


def _box(size: int) -> gym.Space[Floats]:
    return gym.spaces.Box(-math.inf, math.inf, (size,), np.float32)
