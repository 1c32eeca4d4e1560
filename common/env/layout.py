"""What the numbers of an environment's observations and actions are; readable without gymnasium.

Shapes: O numbers of an observation, A of an action, in the order in which the agent sees them.
"""

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rmc.common.errors import ConfigError
from rmc.common.window import Doubles, Floats

NUMBERS = re.compile(r"bool|u?int(8|16|32|64)|float(16|32|64|128)")  # what numpy calls them


@dataclass(frozen=True)
class Part:
    """One box among the numbers of an observation or an action."""

    name: str
    """Dotted path in a Dict or Tuple, or what MuJoCo's bodies call it; empty where the space is one box."""
    start: int
    """Its first number."""
    stop: int
    """One after its last number."""
    shape: tuple[int, ...]
    """In the environment."""
    dtype: str
    """In the environment."""


@dataclass(frozen=True)
class EnvLayout:
    """What the agent reads and gives. Raises ConfigError where it contradicts itself."""

    observations: tuple[Part, ...]
    """Of one frame."""
    frames: int
    """Frames side by side that make the agent's observation, oldest first."""
    actions: tuple[Part, ...]
    action_low: tuple[float, ...]
    """(A,) lowest values in the environment's units."""
    action_high: tuple[float, ...]
    """(A,) highest values in the environment's units."""
    time_limit: int | None
    """Longest episode in the agent's steps; None where there is no limit."""
    missing: int = 1
    """M, flags of what is missing: 1 for a whole frame, or O where they come one by one."""
    privileged: int = 0
    """P, numbers that critics alone read."""

    def __post_init__(self) -> None:
        for name, parts in (("observations", self.observations), ("actions", self.actions)):
            starts, stops = [part.start for part in parts], [part.stop for part in parts]
            numbers = [int(np.prod(part.shape)) for part in parts]
            if any(min(part.shape, default=0) < 0 or not NUMBERS.fullmatch(part.dtype) for part in parts):
                raise ConfigError(f"layout {name}", parts, "must be boxes of numbers; restore the file")
            if not parts or starts != [0, *stops[:-1]] or numbers != [part.stop - part.start for part in parts]:
                raise ConfigError(f"layout {name}", starts, "parts must follow each other; restore the file")
        low, high = np.array(self.action_low), np.array(self.action_high)
        if not (low.shape == high.shape == (self.action_dim,) and np.isfinite(low).all() and (low < high).all()):
            raise ConfigError("layout action_low", self.action_low, "must lie below action_high; restore the file")
        if self.frames < 1:
            raise ConfigError("layout frames", self.frames, "must be 1 or more; restore the file")
        if self.missing not in (1, self.obs_dim):
            raise ConfigError("layout missing", self.missing, f"must be 1 or {self.obs_dim}; restore the file")
        if self.privileged < 0:
            raise ConfigError("layout privileged", self.privileged, "must be 0 or more; restore the file")

    @property
    def obs_dim(self) -> int:
        """O, all frames together."""
        return self.frames * self.observations[-1].stop

    @property
    def action_dim(self) -> int:
        """A."""
        return self.actions[-1].stop


class ActionScale:
    """Actions in [-1, 1] stretched over an environment's own bounds, (A,) each."""

    def __init__(self, low: Doubles, high: Doubles) -> None:
        self._low, self._high, self._half_range = low, high, (high - low) / 2
        self._plain = bool((low == -1.0).all() and (high == 1.0).all())

    def __call__(self, action: Floats) -> NDArray[np.floating]:
        """(..., A) -> (..., A) in the environment's units; the same array where those are [-1, 1]."""
        if self._plain:
            return action
        stretched: Doubles = (self._low + (action + 1.0) * self._half_range).clip(self._low, self._high)
        return stretched
