"""The sizes of an environment that an agent is made for, and that a run goes on with."""

from typing import Any

from rmc.common.env.config import EnvConfig
from rmc.common.env.describe import layout_of
from rmc.common.env.layout import EnvLayout
from rmc.common.env.wrappers import Env
from rmc.common.errors import ConfigError

FLAGS = "flags of what is missing"


def layout_sizes(layout: EnvLayout) -> dict[str, Any]:
    """Those that every agent depends on, as ``RunConfig.sizes`` names them."""
    extremes = {"the lowest actions": list(layout.action_low), "the highest actions": list(layout.action_high)}
    return {"observations": layout.obs_dim, "actions": layout.action_dim, **extremes}


def env_sizes(env: Env, config: EnvConfig) -> dict[str, Any]:
    """The same of an environment as ``make_env`` gives it."""
    return layout_sizes(layout_of(env, config, {}, privileged=False))


def check_sizes(env_id: str, before: dict[str, Any], sizes: dict[str, Any]) -> None:
    """Raises ConfigError where the environment has other ``sizes`` than ``before``, when the run began."""
    for name, now in sizes.items():
        if before.get(name, now) != now:
            what = f"{name} {now}" if isinstance(now, list) else f"{now} {name}"
            fault = f"the environment now has {what}, the run was trained with {before[name]!r}"
            raise ConfigError("ENV", env_id, f"{fault}; undo that, or train another run")
