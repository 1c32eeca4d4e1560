"""What takes observations away: whole frames, or each dimension on its own.

Shapes: O observation, M of what can be missing on its own: 1 for the frame, O for its dimensions.
"""

from typing import Any

import numpy as np

from rmc.common.env.wrappers import CorruptObservation, Env
from rmc.common.window import BoolArray, Floats


class Missing(CorruptObservation):
    """Zeros in place of what is missing, as ``info["missing"]`` says; what was missing before stays so.

    Each of the M is a Markov chain of its own. It begins at every reset, missing with probability p. Then missing stays
    missing with probability s = max(1 - 1/n, p), and seen becomes missing with probability p (1 - s) / (1 - p).
    So at every step the share p is missing, in bursts of n steps in the mean. Chance alone makes bursts of 1 / (1 - p):
    up to that n, s = p, and steps are independent.
    """

    def __init__(self, env: Env, probability: float, burst: float, chains: int) -> None:
        super().__init__(env)
        self._probability, self._chains = probability, chains
        self._stay = max(1.0 - 1.0 / burst, probability)
        self._enter = probability * ((1.0 - self._stay) / (1.0 - probability)) if probability < 1.0 else 1.0
        self._was: BoolArray | None = None  # at the step before, in this episode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        self._was = None
        return super().reset(seed=seed, options=options)

    def draw(self) -> BoolArray:
        """(M,) what is missing at the next step, by M random numbers."""
        now = self._probability if self._was is None else np.where(self._was, self._stay, self._enter)
        self._was = self._rng.random(self._chains) < now
        return self._was

    def seen(self, observation: Floats, info: dict[str, Any]) -> tuple[Floats, dict[str, Any]]:
        missing = self.draw() if self._chains > 1 else bool(self.draw()[0])
        return np.where(missing, np.float32(0.0), observation), info | {"missing": info.get("missing", False) | missing}


class Flicker(Missing):
    """Whole observations become zeros; ``info["missing"]`` is a bool, or (O,) bools where the environment's is."""

    stream = 0xF11C

    def __init__(self, env: Env, probability: float, burst: float = 1.0) -> None:
        super().__init__(env, probability, burst, chains=1)


class DropSensors(Missing):
    """Each dimension becomes zero on its own; ``info["missing"]`` is (O,) bools."""

    stream = 0xD20B

    def __init__(self, env: Env, probability: float, burst: float = 1.0) -> None:
        assert env.observation_space.shape
        super().__init__(env, probability, burst, chains=env.observation_space.shape[0])
