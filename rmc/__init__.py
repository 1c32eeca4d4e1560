"""RMC, a Recurrent Model with Curiosity: recurrent off-policy agents with a world model, for continuous control.

    import rmc

    config = rmc.presets.robust(rmc.EnvConfig("HalfCheetah-v5"))
    result = rmc.train(config, "runs/first")
    print(rmc.evaluate("runs/first")["eval_return_mean"])
    policy = rmc.load_policy("runs/first")

Names are imported when they are first used, so that ``import rmc`` itself loads nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rmc.analysis.policy import Policy, load_policy
    from rmc.api import evaluate, load_config, resume, train
    from rmc.common.env.config import EnvConfig
    from rmc.common.errors import ConfigError, RmcError
    from rmc.deploy.run import presets
    from rmc.deploy.run.config import RunConfig

    __version__: str

__all__ = [
    "ConfigError",
    "EnvConfig",
    "Policy",
    "RmcError",
    "RunConfig",
    "evaluate",
    "load_config",
    "load_policy",
    "presets",
    "resume",
    "train",
]

_HOMES = {
    "ConfigError": "rmc.common.errors",
    "EnvConfig": "rmc.common.env.config",
    "Policy": "rmc.analysis.policy",
    "RmcError": "rmc.common.errors",
    "RunConfig": "rmc.deploy.run.config",
    "evaluate": "rmc.api",
    "load_config": "rmc.api",
    "load_policy": "rmc.analysis.policy",
    "resume": "rmc.api",
    "train": "rmc.api",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("rmc-rl")
    if name == "presets":
        return importlib.import_module("rmc.deploy.run.presets")
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'rmc' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
