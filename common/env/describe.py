"""What the numbers of a made environment are: which parts its observation has, and which of them are shown."""

from typing import Any

import gymnasium as gym
import numpy as np

from rmc.common.env.config import EnvConfig
from rmc.common.env.faults import call_env
from rmc.common.env.layout import EnvLayout, Part
from rmc.common.env.spaces import bounds, parts
from rmc.common.env.wrappers import Env


def structure(env: gym.Env[Any, Any]) -> dict[str, int]:
    """Names and sizes of the observation's parts in order, where the environment tells them (MuJoCo's bodies)."""
    told = call_env("observation_structure", getattr, env.unwrapped, "observation_structure", None)
    named = told if isinstance(told, dict) else {}
    if not all(isinstance(name, str) and isinstance(size, int | np.integer) for name, size in named.items()):
        return {}  # of that name, but something else
    return {name: int(size) for name, size in named.items() if not name.startswith("skipped")}


def visible_slice(env: gym.Env[Any, Any], hide: str) -> slice | None:
    """Positions come first, and what follows is velocities and what depends on them; None shows all."""
    positions = structure(env).get("qpos", 0)
    return {"nothing": None, "velocities": slice(0, positions), "positions": slice(positions, None)}[hide]


def agent_steps(limit: int | None, config: EnvConfig) -> int | None:
    """A limit in the environment's steps as one in the agent's, of which the last may be a part."""
    return None if limit is None else -(-limit // config.action_repeat)


def layout_of(env: Env, config: EnvConfig, info: dict[str, Any], privileged: bool) -> EnvLayout:
    """Of an environment as ``make_env`` gives it; ``info`` is that of its first reset.

    Without ``privileged`` what it gives under that name is its own affair.
    """
    observations, actions = env.get_wrapper_attr("raw_observation_space"), env.get_wrapper_attr("raw_action_space")
    low, high = bounds(actions)
    limit = env.spec.max_episode_steps if env.spec else None
    return EnvLayout(
        _of_slice(_named(parts(observations), structure(env)), visible_slice(env, config.hide)),
        config.frame_stack,
        parts(actions),
        tuple(low.tolist()),
        tuple(high.tolist()),
        agent_steps(limit, config),
        np.size(info.get("missing", False)),
        np.size(info.get("privileged", ())) if privileged else 0,
    )


def _named(boxes: tuple[Part, ...], names: dict[str, int]) -> tuple[Part, ...]:
    """One box in the parts that the environment says it has."""
    if len(boxes) != 1 or sum(names.values()) != boxes[0].stop:
        return boxes
    named, at = [], 0
    for name, size in names.items():
        if size:
            named.append(Part(name, at, at + size, (size,), boxes[0].dtype))
            at += size
    return tuple(named)


def _of_slice(all_parts: tuple[Part, ...], part_range: slice | None) -> tuple[Part, ...]:
    """Those that are shown; ``part_range`` begins and ends with parts."""
    if part_range is None:
        return all_parts
    first, last, _ = part_range.indices(all_parts[-1].stop)
    kept = [part for part in all_parts if first <= part.start and part.stop <= last]
    return tuple(Part(part.name, part.start - first, part.stop - first, part.shape, part.dtype) for part in kept)
