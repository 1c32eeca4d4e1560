"""What stands between an environment and the agent: one class for each thing done to what is seen.

Shapes: O observation, A action.
"""

import logging
import math
import reprlib
from collections import deque
from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import gymnasium as gym
import numpy as np

from rmc.common.env.faults import call_env
from rmc.common.env.layout import ActionScale
from rmc.common.env.spaces import array, bounds, check_finite, vector
from rmc.common.errors import EnvFault
from rmc.common.window import BoolArray, Floats

Env = gym.Env[Floats, Floats]
log = logging.getLogger(__name__)
RESET, STEP = ("observation", "info"), ("observation", "reward", "terminated", "truncated", "info")


class RescaledEnv(gym.Wrapper[Floats, Floats, Any, Any]):
    """Observations as (O,) float32; actions in [-1, 1], stretched over the environment's own bounds, in its own shapes.

    The one judgement of what a user's environment gives: raises EnvFault where it is not what gymnasium asks for.
    ``info["missing"]`` says that a frame is missing, or in an array of O which of its numbers are, from the first reset
    on; ``info["blank"]``, its old name, is understood with one warning.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self._by_number: bool | None = None  # whether ``info["missing"]`` is an array, once that is known
        self.raw_observation_space, self.raw_action_space = env.observation_space, env.action_space
        low, high = bounds(env.action_space)
        self._scale = ActionScale(low, high)
        self._vectors = isinstance(env.action_space, gym.spaces.Box) and len(env.action_space.shape) == 1
        self.action_space = gym.spaces.Box(-1.0, 1.0, low.shape, np.float32)
        self.observation_space = _box(gym.spaces.flatdim(env.observation_space))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        result = call_env("reset", partial(self.env.reset, seed=seed, options=options))
        observation, info = _values("reset", result, RESET)
        return self._vector(observation), self._own(info)

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        result = call_env("step", self.env.step, self._stretched(action))
        observation, reward, terminated, truncated, info = _values("step", result, STEP)
        ends = _bool("terminated", terminated), _bool("truncated", truncated)
        return self._vector(observation), _number("reward", reward), *ends, self._own(info)

    def render(self) -> Any:
        return call_env("render", self.env.render)

    def close(self) -> None:
        """What it raises is said once, and harms nobody."""
        try:
            call_env("close", self.env.close)
        except EnvFault as fault:
            _warn_once(f"{fault}; it is left as it is")

    def _vector(self, observation: Any) -> Floats:
        """(O,). Raises EnvFault here, before a wrapper hides, delays or blanks it: a broken simulator is broken now."""
        numbers = vector(self.raw_observation_space, observation)
        check_finite("observation", numbers)
        return numbers

    def _own(self, info: Any) -> dict[str, Any]:
        own = _plain_info(info, math.prod(self.observation_space.shape or ()))
        is_array = isinstance(own.get("missing"), np.ndarray)
        if self._by_number is None:
            self._by_number = is_array
        if is_array and not self._by_number:
            fix = "return an array from the first reset on, or bools alone"
            raise EnvFault(f'the environment\'s info["missing"] is an array, at its first reset it was none; {fix}')
        return own

    def _stretched(self, action: Floats) -> Any:
        """(A,) in [-1, 1] -> an action of the environment's own space, which it may change as it likes."""
        scaled = self._scale(action)
        if self._vectors:
            return np.array(scaled, self.raw_action_space.dtype)
        return gym.spaces.unflatten(self.raw_action_space, scaled.astype(np.float64))


def _values(method: str, result: Any, expected: tuple[str, ...]) -> Sequence[Any]:
    if isinstance(result, tuple | list) and len(result) == len(expected):
        return result
    shape = f"{len(result)} values" if isinstance(result, tuple | list) else f"a {type(result).__name__}"
    raise EnvFault(f"the environment's {method} gives {shape}; return ({', '.join(expected)})")


def _number(name: str, value: Any, expected: str = "a number") -> float:
    """A number, also as an array of one."""
    if isinstance(value, float):
        return float(value)
    numbers = array(name, value, expected)
    if numbers.size != 1:
        raise EnvFault(f"the environment's {name} is {reprlib.repr(value)}; return {expected}")
    return float(numbers.item())


def _bool(name: str, value: Any) -> bool:
    if isinstance(value, bool):
        return value
    number = _number(name, value, "a bool")
    if number not in (0.0, 1.0):
        raise EnvFault(f"the environment's {name} is {number:g}; return a bool")
    return bool(number)


def _missing(value: Any, size: int) -> bool | BoolArray:
    """A bool for the whole frame, or (O,) bools where there is one for each of its ``size`` numbers."""
    if isinstance(value, bool):
        return value
    flags = array('info["missing"]', value, "a bool")
    if flags.size == 1:
        return bool(flags.item())
    if flags.shape != (size,):
        fix = f"return a bool, or an array of {size} bools"
        raise EnvFault(f'the environment\'s info["missing"] has shape {flags.shape}; {fix}')
    return flags.astype(np.bool_)


def _plain_info(info: Any, size: int) -> dict[str, Any]:
    """A copy of ``info``, what is missing as a bool or (O,) bools, also under the name that it had in 0.1."""
    if not isinstance(info, dict):
        raise EnvFault(f"the environment's info is {reprlib.repr(info)}; return a dict, {{}} if it says nothing")
    own = info.copy()
    if "blank" in own and "missing" not in own:
        _warn_once(
            'the environment gives info["blank"]; call it info["missing"], the old name goes in the next version'
        )
        own["missing"] = own.pop("blank")
    if "missing" in own:
        own["missing"] = _missing(own["missing"], size)
    return own


@cache
def _warn_once(text: str) -> None:
    log.warning("%s", text)


class SeenWrapper(gym.Wrapper[Floats, Floats, Floats, Floats]):
    """Changes what is seen of an environment, and nothing else of it."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        return self.seen(*self.env.reset(seed=seed, options=options))

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        observation, info = self.seen(observation, info)
        return observation, float(reward), terminated, truncated, info

    def seen(self, observation: Floats, info: dict[str, Any]) -> tuple[Floats, dict[str, Any]]:
        """An observation and its ``info`` as they are -> as they are seen."""
        raise NotImplementedError


class ObservationSlice(SeenWrapper):
    """Only some of the observation's dimensions."""

    def __init__(self, env: Env, shown: slice) -> None:
        super().__init__(env)
        self._shown = shown
        size = range(*shown.indices(env.observation_space.shape[0] if env.observation_space.shape else 0))
        self.observation_space = _box(len(size))

    def seen(self, observation: Floats, info: dict[str, Any]) -> tuple[Floats, dict[str, Any]]:
        flags = info.get("missing")
        own = {"missing": flags[self._shown]} if isinstance(flags, np.ndarray) else {}
        return observation[self._shown], info | own


class CorruptObservation(SeenWrapper):
    """Observations that chance changes; its random numbers are the episode's seed's, apart from the environment's."""

    stream: int  # keeps the random numbers of different disturbances apart

    def __init__(self, env: Env) -> None:
        super().__init__(env)
        self._rng = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        if seed is not None:
            self._rng = np.random.default_rng([seed, self.stream])
        return super().reset(seed=seed, options=options)


class Noise(CorruptObservation):
    """Independent Gaussian noise on every dimension of every observation."""

    stream = 0x2015E

    def __init__(self, env: Env, deviation: float) -> None:
        super().__init__(env)
        self._deviation = deviation

    def seen(self, observation: Floats, info: dict[str, Any]) -> tuple[Floats, dict[str, Any]]:
        noisy = observation + self._deviation * self._rng.standard_normal(observation.shape, np.float32)
        return np.where(info.get("missing", False), observation, noisy), info


class Delay(SeenWrapper):
    """The observation of some steps ago, and whether it was missing; until then the episode's first one.

    Rewards, ends and what else ``info`` says are of now.
    """

    def __init__(self, env: Env, steps: int) -> None:
        super().__init__(env)
        self._past: deque[tuple[Floats, Any]] = deque(maxlen=steps + 1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        self._past.clear()
        return super().reset(seed=seed, options=options)

    def seen(self, observation: Floats, info: dict[str, Any]) -> tuple[Floats, dict[str, Any]]:
        self._past.extend([(observation, info.get("missing", False))] * (1 if self._past else self._past.maxlen or 1))
        observation, missing = self._past[0]
        return observation, info | {"missing": missing}


class FrameStack(SeenWrapper):
    """The newest observations side by side, oldest first; the first one of an episode stands for those before it.

    What is missing is zeros: a stack has no flags.
    """

    def __init__(self, env: Env, frames: int) -> None:
        super().__init__(env)
        assert env.observation_space.shape
        self._frames: deque[Floats] = deque(maxlen=frames)
        self.observation_space = _box(frames * env.observation_space.shape[0])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        self._frames.clear()
        return super().reset(seed=seed, options=options)

    def seen(self, observation: Floats, info: dict[str, Any]) -> tuple[Floats, dict[str, Any]]:
        observation = np.where(info.get("missing", False), np.float32(0), observation)
        self._frames.extend([observation] * (1 if self._frames else self._frames.maxlen or 1))
        return np.concatenate(self._frames), info | {"missing": False}


def _box(size: int) -> gym.Space[Floats]:
    return gym.spaces.Box(-math.inf, math.inf, (size,), np.float32)
