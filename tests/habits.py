"""Environments that are sound but for one habit, which their keyword names."""

import subprocess
import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

STEPS = 12


class Slide(gym.Env[Any, Any]):
    """A point on a line, pushed to 0 in episodes of 12 steps. Observation: place, speed, step."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (gymnasium's own way)
    observation_space: gym.Space[Any] = Box(-99.0, 99.0, (3,), np.float32)
    action_space: gym.Space[Any] = Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.place, self.speed, self.steps = float(self.np_random.uniform(-2, 2)), 0.0, 0
        return self.seen(), {}

    def step(self, action: Any) -> Any:
        self.speed += 0.1 * float(np.ravel(action).sum())
        self.place, self.steps = self.place + 0.1 * self.speed, self.steps + 1
        return self.seen(), -abs(self.place), False, self.steps >= STEPS, {}

    def seen(self) -> Any:
        return np.array([self.place, self.speed, self.steps], np.float32)


class InPlace(Slide):
    """Scales the very array that it is given; asks that it be of its space."""

    def __init__(self, dtype: str = "float32", bound: float = 1.0) -> None:
        self.action_space = Box(-bound, bound, (2,), np.dtype(dtype).type)
        self.taken: list[Any] = []

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action), f"{action!r} is not in {self.action_space}"
        self.taken.append(action.copy())
        action *= 3
        return super().step(action)


class Gives(Slide):
    """Gives something in place of one part of what a step gives, from its second step on."""

    def __init__(self, part: int, value: Any) -> None:
        self.part, self.value = part, value

    def step(self, action: Any) -> Any:
        given = list(super().step(action))
        if self.steps > 1:
            given[self.part] = self.value
        return tuple(given)


class CannotClose(Slide):
    """Its close raises."""

    def close(self) -> None:
        raise RuntimeError("already closed")


class Shaped(Slide):
    """The same numbers in another shape, actions too; a step asks for the shape of its space."""

    def __init__(self, shape: str) -> None:
        self.shape = shape
        plain, numbers = Box(-99.0, 99.0, (3,), np.float32), Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = {
            "column": Box(-99.0, 99.0, (3, 1), np.float32),
            "row": Box(-99.0, 99.0, (1, 3), np.float32),
            "nested": gym.spaces.Dict(a=gym.spaces.Dict(place=Box(-99.0, 99.0, ())), b=Box(-99.0, 99.0, (2,))),
            "tuple": gym.spaces.Tuple([Box(-99.0, 99.0, (1,)), Box(-99.0, 99.0, (2, 1))]),
        }.get(shape, plain)
        self.action_space = {
            "column": Box(-2.0, 2.0, (2, 1), np.float32),
            "nested": gym.spaces.Dict(left=Box(-3.0, 3.0, ()), right=Box(-1.0, 1.0, (1,), np.float16)),
            "tuple": gym.spaces.Tuple([Box(-1.0, 1.0, (1,)), Box(0.0, 1.0, (1, 1), np.float64)]),
        }.get(shape, numbers)

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action), f"{action!r} is not in {self.action_space}"
        return super().step([float(np.ravel(part)[0]) for part in _parts(action)])

    def seen(self) -> Any:
        place, *others = numbers = super().seen()
        return {
            "column": numbers.reshape(3, 1),
            "row": numbers.reshape(1, 3),
            "nested": {"a": {"place": np.array(place)}, "b": np.array(others)},
            "tuple": (numbers[:1], numbers[1:].reshape(2, 1)),
        }.get(self.shape, numbers)


def _parts(action: Any) -> list[Any]:
    return list(action.values()) if isinstance(action, dict) else list(action)


class Wants(Slide):
    """Cannot be made without a keyword."""

    def __init__(self, goal: float, size: int = 3, name: str = "maze") -> None:
        assert type(goal) is float
        self.goal = goal
        self.observation_space = Box(-99.0, 99.0, (size,), np.float32)

    def seen(self) -> Any:
        size = self.observation_space.shape[0]  # type: ignore[index]
        return np.resize(super().seen() + np.float32(self.goal), size)


class Stumbles(Slide):
    """Its step raises in a helper, in a library that the helper calls."""

    def step(self, action: Any) -> Any:
        return self.simulate(action)

    def simulate(self, action: Any) -> Any:
        return np.linalg.inv(np.zeros((2, 2)))  # the line that must be named


class Untyped(Slide):
    """Its rewards are words."""

    def step(self, action: Any) -> Any:
        seen, _, *others = super().step(action)
        return (seen, "much", *others)


class TakesNoMode(Slide):
    """Says that it draws, but cannot be asked to."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self) -> None: ...


class LateSpaces(gym.Env[Any, Any]):
    """Knows its spaces only after a reset."""


class NoRobot(Slide):
    """Asks hardware for its space."""

    @property
    def observation_space(self) -> Any:  # type: ignore[override]
        raise RuntimeError("no robot answers")


class Mistyped(Slide):
    """Its making has a fault of the kind that a wrong keyword gives, too."""

    def __init__(self) -> None:
        self.name = "slide" + 1  # type: ignore[operator]


PICTURES = {
    "sound": np.zeros((33, 40, 3), np.uint8),
    "none": None,
    "floats": np.zeros((32, 40, 3)),
    "list": [np.zeros((32, 40, 3), np.uint8)],
    "with alpha": np.zeros((32, 40, 4), np.uint8),
}


class Draws(Slide):
    """Gives a picture of some kind."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self, picture: str, render_mode: str | None = None, late: float = 0.0, simulator: Sequence[str] = ()
    ) -> None:
        self.picture, self.render_mode, self.late = picture, render_mode, late
        self.simulator = subprocess.Popen(simulator) if simulator else None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        time.sleep(self.late)
        return super().reset(seed=seed, options=options)

    def render(self) -> Any:
        if self.picture == "noise":  # which no codec makes small
            return self.np_random.integers(0, 256, (128, 128, 3), np.uint8)
        return PICTURES[self.picture]


class Masked(gym.ObservationWrapper[Any, Any, Any]):
    """A wrapper's class as an entry point."""

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(Draws("sound", render_mode))

    def observation(self, observation: Any) -> Any:
        return observation


class Dead(gym.Wrapper[Any, Any, Any, Any]):
    """Breaks in its first step."""

    def step(self, action: Any) -> Any:
        raise RuntimeError("it is dead")


for _kind in (Slide, *Slide.__subclasses__(), Masked, LateSpaces):
    gym.register(f"{_kind.__name__}-v0", entry_point=_kind)
gym.register("NoModule-v0", entry_point="tests.nowhere:Env")
