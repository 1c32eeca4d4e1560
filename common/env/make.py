"""Environments as the agent sees them: float32 vectors in, actions in [-1, 1] out, frames that may flicker.

Shapes: O observation, A action.
"""

import inspect
import logging
import operator
import traceback
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from rmc.common.env.config import EnvConfig, check_env_config
from rmc.common.env.describe import agent_steps, layout_of, structure, visible_slice
from rmc.common.env.faults import PASSED_ON, call_env, describe_error
from rmc.common.env.layout import EnvLayout
from rmc.common.env.missing import DropSensors, Flicker
from rmc.common.env.privileged import Privileged
from rmc.common.env.process_state import ApartCall
from rmc.common.env.registered import DM_CONTROL, entry_point, find_spec
from rmc.common.env.spaces import space_fault
from rmc.common.env.watched_env import WatchedEnv
from rmc.common.env.wrappers import Delay, Env, FrameStack, Noise, ObservationSlice, RescaledEnv
from rmc.common.errors import ConfigError, EnvFault, RmcError, one_line
from rmc.common.extra import how_to_install

log = logging.getLogger(__name__)


def make_env(config: EnvConfig, render: bool = False, privileged: bool = False) -> Env:
    """One environment: (O,) float32 observations, (A,) float32 actions in [-1, 1], cut off at its time limit.

    With ``render``, its ``render()`` gives frames; with ``privileged``, its ``info["privileged"]`` what critics alone
    read, where there is anything. Raises ConfigError where it is unknown, or its spaces are none that
    the agent can learn in; EnvFault where it raises.
    """
    check_env_config(config)
    _redirect_mujoco_warnings()
    with ApartCall(config.id, "make", config.env_timeout):
        spec = find_spec(config.id)
        limit = config.time_limit or _registered_limit(config.id, spec.max_episode_steps)
        made = _make(spec, config, render)
        own = made.spec.max_episode_steps if made.spec else None  # of a wrapper of the user's, which may go on past it
    env = WatchedEnv(made, config.id, config.env_timeout)
    try:
        _check_fit(env, config, limit or own)
    except ConfigError:
        with suppress(EnvFault):
            call_env("close", env.close)
        raise
    return _as_seen(env, config, limit, privileged)


def _check_fit(env: gym.Env[Any, Any], config: EnvConfig, limit: int | None) -> None:
    """Raises ConfigError for spaces in which the agent cannot learn, or options that show nothing of them."""
    fault = call_env("spaces", lambda: space_fault(env.observation_space, env.action_space))
    if fault is None and config.hide != "nothing" and not _says_parts(env):
        fault = f"it does not say which observations are {config.hide}; --hide is for MuJoCo's bodies, like Ant-v5"
    if fault is not None:
        raise ConfigError("ENV", config.id, fault)
    steps = agent_steps(limit, config)
    if steps is not None and config.delay and config.delay >= steps - 1:  # all actions would see the first observation
        raise ConfigError("--delay", config.delay, f"an episode ends after {steps} steps; take fewer than {steps - 1}")


def _says_parts(env: gym.Env[Any, Any]) -> bool:
    """Whether it says which parts an observation has, all of it, positions first: a wrapper may have added to them."""
    told, size = structure(env), gym.spaces.flatdim(env.observation_space)
    return next(iter(told), None) == "qpos" and 0 < told["qpos"] < sum(told.values()) == size


def _make(registered: EnvSpec, config: EnvConfig, render: bool) -> gym.Env[Any, Any]:
    """As gymnasium makes it, without a limit."""
    spec = copy(registered)
    spec.max_episode_steps = None
    spec.order_enforce = False  # roles reset and step in order; the check costs time at every step
    spec.kwargs = {**spec.kwargs, **config.env_kwargs, **({"render_mode": "rgb_array"} if render else {})}
    try:
        return gym.make(spec, disable_env_checker=True)
    except gym.error.Error as error:
        raise ConfigError("ENV", config.id, f"gymnasium cannot make it ({one_line(error)})") from None
    except PASSED_ON:
        raise
    except BaseException as error:
        if isinstance(error, TypeError) and (fault := _keyword_fault(spec)) is not None:
            raise ConfigError("ENV", config.id, fault) from None
        if not config.id.startswith(DM_CONTROL):
            raise EnvFault(f"the environment cannot be made: {describe_error(error)}") from error
        fix = f"dm_control cannot make it ({one_line(error)}); it wants MuJoCo 3: {how_to_install('dm-control')}"
        raise ConfigError("ENV", config.id, fix) from None


def _keyword_fault(spec: EnvSpec) -> str | None:
    """Which keyword is missing or too many, and what the environment takes; None where it is not that."""
    try:
        takes = inspect.signature(entry_point(spec))
    except ValueError:  # of a class that is not written in Python
        return None
    try:
        takes.bind(**spec.kwargs)
    except TypeError as error:
        return f"it cannot be made: {error}; it takes {takes}: give --env-kwargs NAME=VALUE"
    return None


def _as_seen(env: gym.Env[Any, Any], config: EnvConfig, limit: int | None, privileged: bool) -> Env:
    """The environment as the agent sees it: each wrapper only where it does something."""
    seen_part = visible_slice(env, config.hide)
    wrapped: Env = RescaledEnv(env)  # the innermost: it judges what the user's own code gives
    if privileged:
        wrapped = Privileged(wrapped, take_observation=config.takes_away())
    if limit:
        wrapped = gym.wrappers.TimeLimit(wrapped, limit)
    if config.action_repeat > 1:
        wrapped = gym.wrappers.RepeatAction(wrapped, config.action_repeat)
    if seen_part is not None:
        wrapped = ObservationSlice(wrapped, seen_part)
    if config.noise:
        wrapped = Noise(wrapped, config.noise)
    if config.delay:  # after the noise, which is the sensors' own, and before what is lost on the way
        wrapped = Delay(wrapped, config.delay)
    if config.drop_sensors:
        wrapped = DropSensors(wrapped, config.drop_sensors, config.flicker_burst)
    if config.flicker:
        wrapped = Flicker(wrapped, config.flicker, config.flicker_burst)
    return FrameStack(wrapped, config.frame_stack) if config.frame_stack > 1 else wrapped


def recreate_env(env: Env, make_env: Callable[[], Env], error: BaseException | None) -> Env:
    """Another one in the place of one that broke in ``error``, which is let go first: only one may be able to exist.

    Raises what ``make_env`` raises.
    """
    with suppress(Exception):
        env.close()
    seen: list[BaseException] = []
    while error is not None and error not in seen:  # frames that are over hold the environment
        traceback.clear_frames(error.__traceback__)
        seen.append(error)
        error = error.__cause__ or error.__context__
    if isinstance(env, gym.Wrapper):  # the caller holds the outermost, which may be closed once more
        env.env = gym.Env()
    del env
    return make_env()


def further_env(make_env: Callable[[], Env], what: str) -> Env:
    """One where it is known that a first one can be made.

    Raises ConfigError; RmcError for all else, which says what that may mean.
    """
    try:
        return make_env()
    except ConfigError:
        raise
    except Exception as error:
        fix = "where only one can exist, take --actors 1 --envs-per-actor 1 --episodes 0"
        raise RmcError(f"{what} cannot be made beside the others ({describe_error(error)}); {fix}") from error


def first_env(config: EnvConfig, privileged: bool = False) -> Env:
    """``make_env`` where nothing runs yet: whatever the environment raises is the user's to fix, as a ConfigError."""
    try:
        return make_env(config, privileged=privileged)
    except EnvFault as fault:
        raise ConfigError("ENV", config.id, str(fault)) from None


def env_layout(config: EnvConfig, privileged: bool = False) -> EnvLayout:
    """What the agent reads and gives there. Makes and resets an environment; raises ConfigError.

    With ``privileged`` also where it gives nothing that critics alone could read.
    """
    env = first_env(config, privileged)
    try:
        info = env.reset(seed=0)[1]
        layout = layout_of(env, config, info, privileged)
    except EnvFault as fault:
        raise ConfigError("ENV", config.id, str(fault)) from None
    finally:
        env.close()
    if privileged and not layout.privileged:
        fix = f'{config.id} gives no info["privileged"], and nothing is taken from what is seen; leave the option'
        raise ConfigError("--privileged-critic", True, fix)
    return layout


def _registered_limit(env_id: str, limit: Any) -> int | None:
    """The steps that an environment is registered with. Raises ConfigError where they are no whole number from 1 on."""
    if limit is None:
        return None
    with suppress(TypeError):
        if (steps := operator.index(limit)) >= 1:
            return steps
    fix = "register a whole number from 1 on, or None"
    raise ConfigError("ENV", env_id, f"its max_episode_steps is {limit!r}; {fix}")


def _redirect_mujoco_warnings() -> None:
    """MuJoCo's warnings go to our log, not to stderr and a MUJOCO_LOG.TXT in the working folder."""
    try:
        import mujoco
    except Exception:  # not there, or MUJOCO_GL is wrong: an environment that needs it says so
        return
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_log_mujoco_warning)


def _log_mujoco_warning(message: str) -> None:
    level = logging.DEBUG if "is deprecated" in message else logging.WARNING  # gymnasium's models, not the user's doing
    log.log(level, "mujoco: %s", message)
