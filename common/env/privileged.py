"""What critics alone read: ``info["privileged"]``, the environment's own, or the observation before it is disturbed.

Shapes: O observation, A action, P privileged numbers.
"""

from typing import Any

import numpy as np

from rmc.common.env.spaces import array, check_finite
from rmc.common.env.wrappers import Env, SeenWrapper
from rmc.common.errors import EnvFault
from rmc.common.window import Floats


class Privileged(SeenWrapper):
    """``info["privileged"]`` as (P,) finite float32, of one shape from the first reset on.

    Where the environment gives none, that is the observation (O,), if ``take_observation``; else there is none.
    Raises EnvFault for anything else.
    """

    def __init__(self, env: Env, take_observation: bool) -> None:
        super().__init__(env)
        self._take_observation = take_observation
        self._shape: tuple[int, ...] | None = None  # as the environment gives it; None where it gives none
        self._begun = False

    def seen(self, observation: Floats, info: dict[str, Any]) -> tuple[Floats, dict[str, Any]]:
        given = None
        if "privileged" in info:
            given = array('info["privileged"]', info["privileged"], "an array of numbers")
        shape = None if given is None else given.shape
        if not self._begun:
            self._begun, self._shape = True, shape
        if shape != self._shape:
            fix = "return it in one shape, at each reset and step"
            raise EnvFault(f'the environment\'s info["privileged"] has shape {shape}, at first {self._shape}; {fix}')
        if given is None and not self._take_observation:
            return observation, info
        with np.errstate(over="ignore", under="ignore"):
            numbers = np.array(observation if given is None else given, np.float32).ravel()
        check_finite("observation" if given is None else 'info["privileged"]', numbers)
        return observation, info | {"privileged": numbers}
