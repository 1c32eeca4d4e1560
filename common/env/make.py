"""Environments as the agent sees them: float32 vectors in, actions in [-1, 1] out, frames that may flicker.

Shapes: O observation, A action.
"""

import difflib
import importlib
import importlib.util
import logging
import math
import os
import sys
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from rmc.common.env.config import EnvConfig
from rmc.common.env.process_state import ApartCall
from rmc.common.env.watched_env import WatchedEnv
from rmc.common.env.wrappers import Env, Flicker, Floats, FrameStack, Noise, ObservationSlice, RescaledEnv
from rmc.common.errors import ConfigError, RmcError
from rmc.common.extra import how_to_install

log = logging.getLogger(__name__)
DM_CONTROL = "dm_control/"
SHORTEST_TIMEOUT = 0.1  # seconds
LARGEST_ACTION = 1e9  # of an action space that means its bounds


def make_env(config: EnvConfig, render: bool = False) -> Env:
    """One environment: (O,) float32 observations, (A,) float32 actions in [-1, 1], cut off at its time limit.

    With ``render``, its ``render()`` gives frames. Raises ConfigError where it is unknown, or its spaces are none that
    the agent can learn in.
    """
    _check_numbers(config)
    _redirect_mujoco_warnings()
    with ApartCall(config.id, "make", config.env_timeout):
        made: gym.Env[Any, Any] = WatchedEnv(_make(config, render), config.id, config.env_timeout)
    fault = _space_fault(made.observation_space, made.action_space)
    if fault is None and config.hide != "nothing" and not _structure(made):
        fault = f"it does not say which observations are {config.hide}; --hide is for MuJoCo's bodies, like Ant-v5"
    if fault is not None:
        made.close()
        raise ConfigError("ENV", config.id, fault)
    return _as_seen(made, config)


def _make(config: EnvConfig, render: bool) -> gym.Env[Any, Any]:
    """As gymnasium makes it, with its own limit or ours."""
    spec = copy(_find_spec(config.id))
    spec.order_enforce = False  # roles reset and step in order; the check costs time at every step
    try:
        return gym.make(
            spec,
            max_episode_steps=config.time_limit or None,
            disable_env_checker=True,
            **({"render_mode": "rgb_array"} if render else {}),
        )
    except gym.error.Error as error:
        raise ConfigError("ENV", config.id, f"gymnasium cannot make it ({_one_line(error)})") from None
    except Exception as error:
        if not config.id.startswith(DM_CONTROL):
            raise
        fix = f"dm_control cannot make it ({_one_line(error)}); it wants MuJoCo 3: {how_to_install('dm-control')}"
        raise ConfigError("ENV", config.id, fix) from None


def _as_seen(env: gym.Env[Any, Any], config: EnvConfig) -> Env:
    """The environment as the agent sees it: each wrapper only where it does something."""
    shown = _shown(env, config.hide)
    if isinstance(env.observation_space, gym.spaces.Dict):
        env = gym.wrappers.FlattenObservation(env)
    if config.action_repeat > 1:
        env = gym.wrappers.RepeatAction(env, config.action_repeat)
    seen: Env = RescaledEnv(env)
    if shown is not None:
        seen = ObservationSlice(seen, shown)
    if config.noise:
        seen = Noise(seen, config.noise)
    if config.flicker:
        seen = Flicker(seen, config.flicker)
    return FrameStack(seen, config.frame_stack) if config.frame_stack > 1 else seen


def checked_reset(env: Env, seed: int | None) -> tuple[Floats, dict[str, Any]]:
    """Reset. Raises ValueError where the observation is not finite."""
    observation, info = env.reset(seed=seed)
    if not np.isfinite(observation).all():
        raise ValueError("its first observation is not finite")
    return observation, info


def recreate_env(env: Env, make_env: Callable[[], Env]) -> Env:
    """Another one in the place of a broken one."""
    with suppress(Exception):
        env.close()
    return make_env()


def further_env(make_env: Callable[[], Env], what: str) -> Env:
    """One where it is known that a first one can be made. Raises RmcError, which says what that may mean."""
    try:
        return make_env()
    except Exception as error:
        fix = "where only one can exist, take --actors 1 --envs-per-actor 1 --episodes 0"
        raise RmcError(f"{what} cannot be made beside the others ({type(error).__name__}: {error}); {fix}") from error


def first_env(config: EnvConfig) -> Env:
    """``make_env`` where nothing runs yet: whatever the environment raises is the user's to mend, as a ConfigError."""
    try:
        return make_env(config)
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError("ENV", config.id, f"it cannot be made: {_told(error)}") from None


def env_spaces(config: EnvConfig) -> tuple[int, int, int | None]:
    """O, A and the time limit in the agent's steps (None where there is none). Raises ConfigError."""
    env = first_env(config)
    limit = env.spec.max_episode_steps if env.spec else None
    env.close()
    assert env.observation_space.shape
    assert env.action_space.shape
    if limit is not None:
        limit = -(-limit // config.action_repeat)
    return env.observation_space.shape[0], env.action_space.shape[0], limit


def _structure(env: gym.Env[Any, Any]) -> dict[str, int]:
    """Names and sizes of the observation's parts in order, where the environment tells them (MuJoCo's bodies)."""
    parts = getattr(env.unwrapped, "observation_structure", None) or {}
    return {name: size for name, size in parts.items() if not name.startswith("skipped")}


def _shown(env: gym.Env[Any, Any], hide: str) -> slice | None:
    """Positions come first, and what follows is velocities and what depends on them; None shows all."""
    positions = _structure(env).get("qpos", 0)
    return {"nothing": None, "velocities": slice(0, positions), "positions": slice(positions, None)}[hide]


def _check_numbers(config: EnvConfig) -> None:
    if not 0.0 <= config.flicker <= 1.0:
        raise ConfigError("--flicker", config.flicker, "a probability from 0 to 1")
    if not 0.0 <= config.noise < math.inf:
        raise ConfigError("--noise", config.noise, "a standard deviation, 0 or more")
    if not config.env_timeout >= SHORTEST_TIMEOUT:
        raise ConfigError("--env-timeout", config.env_timeout, f"{SHORTEST_TIMEOUT} seconds or more")
    for name, least in (("frame_stack", 1), ("action_repeat", 1), ("time_limit", 0)):
        if getattr(config, name) < least:
            raise ConfigError(f"--{name.replace('_', '-')}", getattr(config, name), f"{least} or more")


def _find_spec(env_id: str) -> EnvSpec:
    module, _, name = env_id.rpartition(":")
    if name.startswith(DM_CONTROL):
        _import_dm_control(env_id)
    elif module:
        _import_users_module(env_id, module)
    try:
        return gym.spec(name)
    except gym.error.Error:
        close = difflib.get_close_matches(name, gym.registry, n=3, cutoff=0.5)
        fix = f"did you mean {', '.join(close)}?" if close else "use a gymnasium id or module:EnvId-v0"
        fault = f"{module} registers no {name} (gymnasium.register)" if module else "no such environment"
        raise ConfigError("ENV", env_id, f"{fault}; {fix}") from None


def _space_fault(observation: gym.Space[Any], action: gym.Space[Any]) -> str | None:
    """Why the agent cannot learn with these spaces, and what to do about it; None if it can."""
    Box = gym.spaces.Box
    if isinstance(observation, gym.spaces.Dict):
        odd = {name: type(part).__name__ for name, part in observation.items() if not isinstance(part, Box)}
        if odd:
            return f"of its observations {odd} are no Box; turn them into one, or leave them out"
        images = {name: part.shape for name, part in observation.items() if len(part.shape or ()) > 2}
        if images:
            return f"of its observations {images} are images; only vectors are learnt from, leave them out"
        return _space_fault(gym.spaces.flatten_space(observation), action)
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
    if not np.issubdtype(action.dtype, np.floating):
        return f"its actions are {action.dtype}; only continuous ones (a Box of floats) are learnt"
    if not (np.abs([action.low, action.high]) < LARGEST_ACTION).all():
        return "its action space is unbounded; give it a Box with the low and high that its actions really have"
    return None


def _import_users_module(env_id: str, module: str) -> None:
    """Found in the working folder, too, but there last, so that it cannot shadow ours."""
    folder = os.getcwd()
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        ours = error.name is not None and (module == error.name or module.startswith(f"{error.name}."))
        fix = f"start from the folder that holds {module}" if ours else f"{module} needs it; install it"
        raise ConfigError("ENV", env_id, f"{error}; {fix}") from None
    except Exception as error:
        raise ConfigError("ENV", env_id, f"{module} cannot be imported: {_told(error)}") from None


def _import_dm_control(env_id: str) -> None:
    """Its tasks are gymnasium's once shimmy is imported."""
    if importlib.util.find_spec("dm_control") is None or importlib.util.find_spec("shimmy") is None:
        raise ConfigError("ENV", env_id, f"shimmy or dm_control is missing; {how_to_install('dm-control')}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it looks for a screen, and says so where there is none
        importlib.import_module("shimmy")


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


def _told(error: Exception) -> str:
    """An error of a user's code in a line, with its place."""
    at = traceback.extract_tb(error.__traceback__)[-1]
    place = f" ({Path(at.filename).name}, line {at.lineno})" if not isinstance(error, SyntaxError) else ""
    return f"{type(error).__name__}: {_one_line(error)}{place}"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
