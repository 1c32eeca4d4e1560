"""Environments as the agent sees them: float32 vectors in, actions in [-1, 1] out, frames that may flicker.

Shapes: O observation, A action.
"""

import difflib
import importlib
import logging
import math
import os
import sys
from copy import copy
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from common.errors import ConfigError

Floats = NDArray[np.float32]
Env = gym.Env[Floats, Floats]
log = logging.getLogger(__name__)
_FLICKER_STREAM = 0xF11C  # keeps the flicker's random numbers apart from the environment's own


@dataclass(frozen=True)
class EnvConfig:
    """Which environment, and how much of it is seen."""

    id: str
    """Gymnasium id, like HalfCheetah-v5, or module:EnvId-v0 for your own."""
    flicker: float = 0.0
    """Probability that an observation is replaced by zeros, at every step, the reset included."""


def make_env(config: EnvConfig) -> Env:
    """One environment: (O,) float32 observations, (A,) float32 actions in [-1, 1], gymnasium's time limit kept.

    Raises ConfigError where it is unknown, or its spaces are none that the agent can learn in.
    """
    if not 0.0 <= config.flicker <= 1.0:
        raise ConfigError("--flicker", config.flicker, "a probability from 0 to 1")
    _redirect_mujoco_warnings()
    spec = copy(_find_spec(config.id))
    spec.order_enforce = False  # roles reset and step in order; the check costs time at every step
    try:
        env = gym.make(spec, disable_env_checker=True)
    except gym.error.Error as error:
        raise ConfigError("ENV", config.id, f"gymnasium cannot make it ({_one_line(error)})") from None
    fault = _space_fault(env.observation_space, env.action_space)
    if fault is not None:
        env.close()
        raise ConfigError("ENV", config.id, fault)
    standard: Env = Standardised(env)
    return Flicker(standard, config.flicker) if config.flicker else standard


def env_spaces(config: EnvConfig) -> tuple[int, int, int | None]:
    """O, A and the time limit in steps (None where there is none). Raises ConfigError."""
    env = make_env(config)
    limit = env.spec.max_episode_steps if env.spec else None
    env.close()
    assert env.observation_space.shape
    assert env.action_space.shape
    return env.observation_space.shape[0], env.action_space.shape[0], limit


class Standardised(gym.Wrapper[Floats, Floats, Any, Any]):
    """Observations as float32; actions in [-1, 1], stretched over the environment's own bounds."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        inner = env.action_space
        assert isinstance(inner, gym.spaces.Box)
        assert env.observation_space.shape is not None
        self._low = inner.low.astype(np.float32)
        self._high = inner.high.astype(np.float32)
        self._half_range = (self._high - self._low) / 2
        self._plain = bool((inner.low == -1.0).all() and (inner.high == 1.0).all())
        self._dtype = inner.dtype
        self.action_space = gym.spaces.Box(-1.0, 1.0, inner.shape, np.float32)
        self.observation_space = gym.spaces.Box(-math.inf, math.inf, env.observation_space.shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return np.asarray(observation, np.float32), info

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        if not self._plain:
            stretched = self._low + (action + 1.0) * self._half_range
            action = np.clip(stretched, self._low, self._high).astype(self._dtype)  # rounding may pass a bound
        observation, reward, terminated, truncated, info = self.env.step(action)
        return np.asarray(observation, np.float32), float(reward), terminated, truncated, info


class Flicker(gym.Wrapper[Floats, Floats, Floats, Floats]):
    """Whole observations become zeros, independently with probability p; ``info["blank"]`` says which."""

    def __init__(self, env: Env, probability: float) -> None:
        super().__init__(env)
        self._probability = probability
        self._rng = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        if seed is not None:
            self._rng = np.random.default_rng([seed, _FLICKER_STREAM])
        observation, info = self.env.reset(seed=seed, options=options)
        return self._flicker(observation, info), info

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._flicker(observation, info), float(reward), terminated, truncated, info

    def _flicker(self, observation: Floats, info: dict[str, Any]) -> Floats:
        info["blank"] = bool(self._rng.random() < self._probability)
        return np.zeros_like(observation) if info["blank"] else observation


def _find_spec(env_id: str) -> EnvSpec:
    module, _, name = env_id.rpartition(":")
    if module:
        _import_users_module(env_id, module)
    try:
        return gym.spec(name)
    except gym.error.Error:
        close = difflib.get_close_matches(name, gym.registry, n=3, cutoff=0.5)
        fix = f"did you mean {', '.join(close)}?" if close else "use a gymnasium id or module:EnvId-v0"
        raise ConfigError("ENV", env_id, f"no such environment; {fix}") from None


def _space_fault(observation: gym.Space[Any], action: gym.Space[Any]) -> str | None:
    """Why the agent cannot learn with these spaces, and what to do about it; None if it can."""
    Box = gym.spaces.Box
    if not isinstance(observation, Box):
        return f"its observations are {type(observation).__name__}; flatten them to a Box"
    if len(observation.shape) > 1:
        return f"its observations are images {observation.shape}; only vectors are learnt from"
    if not observation.shape or not observation.shape[0]:
        return f"its observations have shape {observation.shape}; only vectors are learnt from"
    if not isinstance(action, Box):
        return f"its actions are {type(action).__name__}; only continuous ones (a Box) are learnt"
    if len(action.shape) != 1 or not action.shape[0]:
        return f"its actions have shape {action.shape}; only vectors are learnt"
    if not (np.isfinite(action.low).all() and np.isfinite(action.high).all()):
        return "its action space is unbounded; give it a Box with finite low and high"
    return None


def _import_users_module(env_id: str, module: str) -> None:
    """Found in the working folder, too, but there last, so that it cannot shadow ours."""
    folder = os.getcwd()
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ConfigError("ENV", env_id, f"{error}; start from the folder that holds {module}") from None


def _redirect_mujoco_warnings() -> None:
    """MuJoCo's warnings go to our log, not to stderr and a MUJOCO_LOG.TXT in the working folder."""
    try:
        import mujoco
    except ImportError:  # an environment of the user's own needs none
        return
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_log_mujoco_warning)


def _log_mujoco_warning(message: str) -> None:
    level = logging.DEBUG if "is deprecated" in message else logging.WARNING  # gymnasium's models, not the user's doing
    log.log(level, "mujoco: %s", message)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
