"""The N environments of an actor: stepped one after the other, and made anew where they break.

Shapes: N environments, O observation, A action, M flags of what is missing, P privileged numbers.
"""

import logging
from collections.abc import Callable
from typing import Any

import numpy as np

from rmc.actors.window_builder import Transition
from rmc.common.env.make import further_env, recreate_env
from rmc.common.env.wrappers import Env
from rmc.common.errors import EnvFault
from rmc.common.window import BoolArray, Floats, WindowSpec

log = logging.getLogger(__name__)
BROKEN_STARTS = 5  # episodes in a row that an environment breaks in their first step before the actor gives up


class EnvPool:
    """Its buffers hold what the last step gave; ``begin`` starts each episode."""

    def __init__(
        self, make_env: Callable[[], Env], n: int, spec: WindowSpec, name: str, reward_scale: float = 1.0
    ) -> None:
        """``name`` is whose they are, ``reward_scale`` what multiplies rewards later.

        Raises RmcError where one cannot be made beside the others.
        """
        self._make_env, self._spec, self._name = make_env, spec, name
        self._largest_reward = np.float32(np.finfo(np.float32).max / max(1.0, reward_scale))  # finite, scaled, too
        self.broken = 0  # episodes that a fault ended
        self._envs: list[Env] = []
        try:
            for _ in range(n):
                self._envs.append(further_env(make_env, f"an environment of {name}'s {n}"))
        except BaseException:
            self.close()
            raise
        self._given = Transition(
            reward=np.zeros(n, np.float32),
            observation=np.zeros((n, spec.obs_dim), np.float32),
            missing=np.zeros((n, spec.missing), np.bool_),
            terminated=np.zeros(n, np.bool_),
            truncated=np.zeros(n, np.bool_),
            privileged=np.zeros((n, spec.privileged), np.float32),
        )
        self.restart(int)

    def __len__(self) -> int:
        return len(self._envs)

    def restart(self, seed_of: Callable[[int], int]) -> None:
        """Every environment's next episode begins by a seed: ``seed_of(0)`` to ``seed_of(N - 1)``, later ones after."""
        self._seed_of, self._remade = seed_of, 0
        self._seeds_due = {i: i for i in range(len(self._envs))}  # which of the seeds its next episode begins by
        self._broken_starts = dict.fromkeys(self._seeds_due, 0)  # by environment, in a row

    def step(self, action: Floats) -> tuple[Transition, dict[int, Exception]]:
        """(N, A) in [-1, 1] -> what came of it, and who broke: those have zero observation and reward, and no end."""
        faults: dict[int, Exception] = {}
        for i in range(len(self._envs)):
            try:
                self._step_one(i, action[i])
            except Exception as error:
                faults[i] = error
        self._mark_broken(faults)
        return self._given, faults

    def _step_one(self, i: int, action: Floats) -> None:
        given = self._given
        observation, reward, terminated, truncated, info = self._envs[i].step(action)
        given.observation[i], given.reward[i], given.missing[i] = observation, reward, info.get("missing", False)
        given.terminated[i], given.truncated[i] = terminated, truncated
        if self._spec.privileged:
            given.privileged[i] = info["privileged"]

    def _mark_broken(self, faults: dict[int, Exception]) -> None:
        """Whose scaled reward is not finite, too. What a broken one left behind must not end an episode."""
        given = self._given
        rewarded = np.abs(given.reward) <= self._largest_reward
        for i in np.flatnonzero(~rewarded).tolist():
            faults.setdefault(i, EnvFault("the environment's scaled reward is not finite"))
        for i in faults:
            given.observation[i] = given.reward[i] = 0.0
            given.terminated[i] = given.truncated[i] = False

    def begin(self, i: int) -> tuple[Floats, BoolArray | bool, Floats | None]:
        """Reset: (O,) observation, (M,) what of it is missing, (P,) privileged where the run reads that.

        Raises what the environment raises where it breaks, and again when it was made anew.
        """
        number = self._seeds_due.pop(i, None)
        if number is None:  # the episode before has ended as it should
            self._broken_starts[i] = 0
        try:
            observation, info = self._envs[i].reset(seed=None if number is None else self._seed_of(number))
        except Exception as error:
            log.warning("%s: environment %d broke in a reset: %s", self._name, i, error)
            self._make_anew(i, error)
            observation, info = self._envs[i].reset(seed=self._seed_of(self._seeds_due.pop(i)))
        self._check_sizes(info)
        return observation, info.get("missing", False), info["privileged"] if self._spec.privileged else None

    def replace(self, i: int, error: Exception, step: int) -> None:
        """Another one in the place of one that broke in that step of an episode; ``begin`` must follow.

        Raises the error where environments break at the start of one episode after the other: they always will.
        """
        log.warning("%s: environment %d broke in step %d of an episode: %s", self._name, i, step, error)
        self._broken_starts[i] = self._broken_starts[i] + 1 if step <= 1 else 0
        if self._broken_starts[i] >= BROKEN_STARTS:
            raise error
        self._make_anew(i, error)

    def _make_anew(self, i: int, error: Exception) -> None:
        self.broken += 1
        self._remade += 1
        self._envs[i] = recreate_env(self._envs[i], self._make_env, error)
        self._seeds_due[i] = len(self._envs) * self._remade + i

    def _check_sizes(self, info: dict[str, Any]) -> None:
        """Raises EnvFault where a first reset says otherwise than the run's layout what is missing or privileged."""
        numbers = np.size(info.get("privileged", ())) if self._spec.privileged else 0  # else it is its own affair
        for name, size, sizes in (
            ("missing", np.size(info.get("missing", False)), (1, self._spec.missing)),
            ("privileged", numbers, (self._spec.privileged,)),
        ):
            if size not in sizes:
                fault = f'the environment\'s info["{name}"] has {size} values, when the run began {sizes[-1]}'
                raise EnvFault(f"{fault}; give as many at every reset")

    def close(self) -> None:
        for env in self._envs:
            env.close()
