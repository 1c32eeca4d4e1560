"""A trained policy as a library: step it in a loop of your own.

    policy = load_policy("runs/first")
    env = policy.make_env()
    observation, info = env.reset()
    policy.reset()
    action = policy.act(observation, info.get("missing", False))
    observation, reward, terminated, truncated, info = env.step(action)

Shapes: N episodes side by side, O observation, A action, S state, M flags of what is missing.
"""

import copy
import reprlib
from numbers import Integral
from pathlib import Path
from typing import Any, Literal, get_args, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rmc.actors.policy_runner import PolicyRunner, one_thread
from rmc.analysis.evaluation import policy_env
from rmc.analysis.policy_file import PolicyFile, policy_runner, read_policy
from rmc.common.env.config import check_range
from rmc.common.env.layout import ActionScale
from rmc.common.env.wrappers import Env
from rmc.common.errors import ConfigError
from rmc.common.policy_header import PolicyHeader
from rmc.common.process import watchdog
from rmc.common.window import BoolArray, Floats

Units = Literal["agent", "environment"]
UNITS = get_args(Units)


def load_policy(source: str | Path, checkpoint: str = "latest", seed: int = 0) -> "Policy":
    """The policy of a file, of ``hf://owner/name``, or of a run's ``latest``, ``best`` or numbered checkpoint.

    A file is all that it takes: neither its run nor the module of its environment need be there. ``seed`` is for
    actions that explore. Raises ConfigError.
    """
    check_range("seed", seed, (0, 2**63 - 1), Integral)
    return Policy(read_policy(source, checkpoint), seed)


class Policy:
    """Acts, and remembers: ``reset`` at the start of every episode, then ``act`` at every step.

    It acts in one episode, or in N side by side: as many as the first observation after ``reset`` has rows.
    """

    def __init__(self, file: PolicyFile, seed: int = 0) -> None:
        """``seed`` is for actions that explore."""
        self._file, self._rng = file, np.random.default_rng(seed)
        layout = file.header.layout
        self._scale = ActionScale(np.array(layout.action_low), np.array(layout.action_high))
        self._runner: PolicyRunner | None = None
        self._has_begun = False  # whether its episodes have had a step since ``reset``
        self._prev_action = self._state = np.zeros((0, 0), np.float32)  # (N, A), (N, S), once it acts

    @property
    def header(self) -> PolicyHeader:
        """Its sizes, options, environment, steps and return."""
        return self._file.header

    def make_env(self) -> Env:
        """An environment as the policy saw it in training: actions in [-1, 1], and all that the run's options hide.

        Raises ConfigError where its module cannot be imported, or its sizes are others now.
        """
        watchdog.warn()
        return policy_env(self.header, self.header.env)

    def reset(self, index: int | None = None) -> None:
        """Forget: a new episode begins, in all of them or in that of one row. Raises ConfigError."""
        if index is None:
            self._has_begun = False
            return
        if isinstance(index, bool) or not isinstance(index, Integral):  # ``reset(done)`` is not what it seems
            raise ConfigError("index", index, "give the number of an episode, or nothing for all")
        if self._has_begun:
            rows = len(self._state)
            if not -rows <= index < rows:
                raise ConfigError("index", index, f"the policy acts in {rows} episodes, from 0 on")
            self._prev_action[index], self._state[index] = 0.0, 0.0

    @overload
    def act(
        self,
        observation: ArrayLike,
        missing: bool | BoolArray = ...,
        *,
        explore: bool = ...,
        units: Literal["agent"] = ...,
    ) -> Floats: ...
    @overload
    def act(
        self, observation: ArrayLike, missing: bool | BoolArray = ..., *, explore: bool = ..., units: Units
    ) -> NDArray[Any]: ...
    def act(
        self,
        observation: ArrayLike,
        missing: bool | BoolArray = False,
        *,
        explore: bool = False,
        units: Units = "agent",
    ) -> NDArray[Any]:
        """(O,) -> (A,) or (N, O) -> (N, A): the policy's mean, or a sample of it.

        ``missing``, one or (N,), says that the frame is missing (``info["missing"]`` under flicker); where the policy's
        environment says so by number, also (O,) or (N, O). A policy that fills what is missing also takes for missing
        what is not finite. ``units`` "agent" gives float32 in [-1, 1],
        as ``make_env`` takes; "environment" what the environment itself takes: its units, dtype and shape, where its
        action is a Dict or a Tuple all numbers in a row. Raises ConfigError for what it cannot read.
        """
        if units not in UNITS:
            raise ConfigError("units", units, f"use one of {UNITS}")
        rows, absent, one = self._read(observation, missing)
        runner = self._begin(len(rows))
        shape = self._prev_action.shape
        noise = self._rng.standard_normal(shape, np.float32) if explore else None
        with one_thread():
            action, state = runner.act(rows, self._prev_action, absent, self._state, noise)
        if not (np.isfinite(action).all() and np.isfinite(state).all()):  # which it would remember
            fix = f"too large for this policy's networks; give {self._nothing} where a sensor has no reading"
            raise ConfigError("observation", f"up to {np.abs(rows).max():.3g}", fix)
        self._prev_action, self._state[:] = action, state
        result = action.copy() if units == "agent" else self._in_environment(action)
        return result[0] if one else result

    @property
    def _nothing(self) -> str:
        """What stands for a frame that is missing, as in training."""
        return "missing=True" if self.header.layout.frames == 1 else "zeros"

    def _begin(self, rows: int) -> PolicyRunner:
        """What acts in so many episodes; new ones begin after ``reset``."""
        if self._runner is None or rows != len(self._state):
            self._runner = policy_runner(self.header, self._file.blob, rows)
        if not self._has_begun:
            self._prev_action, self._state = self._runner.start()
            self._has_begun = True
        return self._runner

    def __getstate__(self) -> dict[str, Any]:
        """A copy's own memory and noise, without the buffers that it acts with: it makes those when it acts."""
        memory = {"_state": self._state.copy(), "_prev_action": self._prev_action.copy()}
        return self.__dict__ | {"_runner": None, "_rng": copy.deepcopy(self._rng)} | memory

    def _in_environment(self, action: Floats) -> NDArray[Any]:
        """(N, A) in [-1, 1] -> (N, ...) as the environment takes it."""
        parts, scaled = self.header.layout.actions, self._scale(action)
        if len(parts) > 1 or parts[0].name:  # a Dict or a Tuple, be it of one box
            return scaled.astype(np.result_type(*(part.dtype for part in parts)))
        return scaled.astype(parts[0].dtype).reshape(len(action), *parts[0].shape)

    def _read(self, observation: ArrayLike, missing: bool | BoolArray) -> tuple[Floats, BoolArray, bool]:
        """(N, O), (N, M) what counts as missing, and whether it is one observation alone.

        Raises ConfigError; nothing is remembered of it then.
        """
        raw = self._numbers(observation)
        rows, one = self._rows(raw), raw.ndim == 1
        try:
            given = np.array(missing)
        except ValueError:  # rows of several lengths
            raise ConfigError(
                "missing", reprlib.repr(missing), f"give one, or one for each of {len(rows)} rows"
            ) from None
        if given.dtype.kind in "SU":  # any text but an empty one would count as true
            raise ConfigError("missing", reprlib.repr(missing), "give True or False, not text")
        absent = self._absent(given.astype(bool), rows, one)
        odd = ~np.isfinite(rows) & ~absent
        if odd.any():
            if not self.header.agent.impute_missing or self.header.layout.frames > 1:
                places = [place if len(rows) == 1 else (row, place) for row, place in np.argwhere(odd).tolist()]
                values = dict(zip(places, rows[odd].tolist(), strict=True))
                raise ConfigError("observation", values, f"give finite numbers, or {self._nothing} where there is none")
            absent |= odd if absent.shape == odd.shape else odd.any(1, keepdims=True)
        return rows, absent, one

    def _absent(self, missing: BoolArray, rows: Floats, one: bool) -> BoolArray:
        """Flags as they were given -> (N, M); ``one`` row was given as (O,). Raises ConfigError."""
        flags, count = self.header.layout.missing, len(rows)
        if self.header.layout.frames > 1 and missing.any():  # as in training, where a stack has no flags
            raise ConfigError("missing", True, "leave it: a missing frame is zeros in its place of the stack")
        by_number = [(count, flags), *([(flags,)] if one else [])] if flags > 1 else []
        if missing.shape in by_number:
            return missing.reshape(count, flags)
        if missing.shape not in ((), (count,)):
            fix = f"give one, or one for each of {count} rows" + (f", or {flags} for each" if flags > 1 else "")
            raise ConfigError("missing", f"of shape {missing.shape}", fix)
        return np.broadcast_to(missing.reshape(-1, 1), (count, flags)).copy()

    def _numbers(self, observation: ArrayLike) -> Floats:
        """As an array; (O,) where it has the environment's own shape. Raises ConfigError."""
        if isinstance(observation, np.ma.MaskedArray) and np.ma.is_masked(observation):  # the mask would be lost
            fix = f"give its numbers, and {self._nothing} for what it masks"
            raise ConfigError("observation", "a masked array", fix)
        try:
            with np.errstate(over="ignore", under="ignore"):  # infinity is judged later
                raw = np.asarray(observation, np.float32)
        except (TypeError, ValueError, RuntimeError):  # torch raises the last for a tensor with a gradient
            fix = f"give {self.header.obs_dim} numbers, as policy.make_env() or gymnasium.spaces.flatten does"
            raise ConfigError("observation", reprlib.repr(observation), fix) from None
        as_environment = raw.shape == self.header.layout.observations[0].shape and raw.size == self.header.obs_dim
        return raw.ravel() if as_environment else raw

    def _rows(self, raw: Floats) -> Floats:
        """(O,) or (N, O) -> (N, O). Raises ConfigError."""
        size = self.header.obs_dim
        if raw.ndim not in (1, 2) or raw.shape[-1] != size or not len(raw):
            fix = f"the policy reads shape {(size,)}, or (N, {size}) of N episodes"
            raise ConfigError("observation", f"of shape {raw.shape}", fix)
        rows = raw.reshape(-1, size)
        if self._has_begun and len(rows) != len(self._state):
            fix = f"the policy acts in {len(self._state)} episodes; reset() it before there are others"
            raise ConfigError("observation", f"of shape {raw.shape}", fix)
        return rows
