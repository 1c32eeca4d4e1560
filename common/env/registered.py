"""What gymnasium knows by an id: its own environments, those of a user's module, dm_control's and PyBullet's tasks."""

import difflib
import importlib
import importlib.util
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, find_highest_version

from rmc.common.env.faults import PASSED_ON, describe_error
from rmc.common.errors import ConfigError
from rmc.common.extra import how_to_install

DM_CONTROL, PYBULLET = "dm_control/", "pybullet/"


def find_spec(env_id: str) -> EnvSpec:
    """What gymnasium knows of an environment; imports its module. Raises ConfigError."""
    module, _, name = env_id.rpartition(":")
    if name.startswith(DM_CONTROL):
        _import_tasks(env_id, ("shimmy", "dm_control"), "shimmy", how_to_install("dm-control"))
    elif name.startswith(PYBULLET):
        how = f"with Python 3.11: {how_to_install('pybullet')}"
        _import_tasks(env_id, ("pybullet", "pybullet_envs_gymnasium"), "rmc.common.env.pybullet_tasks", how)
    elif module:
        _import_users_module(env_id, module)
    try:
        return gym.spec(name)
    except gym.error.Error:
        raise ConfigError("ENV", env_id, _shadow_fault(module) or _unknown(module, name)) from None


def entry_point(spec: EnvSpec) -> Callable[..., Any]:
    """What makes the environment: its class, or a function."""
    factory = spec.entry_point
    assert factory is not None
    return gym.envs.registration.load_env_creator(factory) if isinstance(factory, str) else factory


def _unknown(module: str, name: str) -> str:
    """That no such environment is registered, and which one may be meant."""
    newest = [one.id for one in gym.registry.values() if one.version == find_highest_version(one.namespace, one.name)]
    close = difflib.get_close_matches(name, newest, n=3, cutoff=0.7)
    fix = f"did you mean {', '.join(close)}?" if close else "use a gymnasium id or module:EnvId-v0"
    own = Path(name).parent / f"{Path(name).stem}.py"
    if not module and os.path.isfile(own):
        fix = f"{own} is here: give {_module_name(own)}:EnvId-v0"
    elif close and not module:
        fix = f"{fix} One of your own is module:{name}"
    file = getattr(sys.modules.get(module), "__file__", None)
    where = f"{module} ({file})" if file else module
    return f"{where} registers no {name} (gymnasium.register); {fix}" if module else f"no such environment; {fix}"


def _module_name(path: Path) -> str:
    """What a file that is given by its path is imported by: below the working folder with its packages."""
    parts = Path(os.path.relpath(path)).parts
    return ".".join(parts[-1:] if ".." in parts else parts).removesuffix(".py").lstrip(".") or "module"


def _shadow_fault(module: str) -> str | None:
    """Which module was imported in place of the one in the working folder, whose name it has; None where none was."""
    parts = module.split(".")
    own = [*filter(os.path.isfile, (Path(*parts[:-1], f"{parts[-1]}.py"), Path(*parts, "__init__.py")))]
    file = getattr(sys.modules.get(module), "__file__", None)
    if not module or not own or (file is not None and Path(file).resolve() == own[0].resolve()):
        return None
    other = getattr(sys.modules.get(parts[0]), "__file__", None) or "a part of Python"
    return f"{parts[0]} is {other}, which is found before yours; give {own[0]} another name"


def _import_users_module(env_id: str, module: str) -> None:
    """Found in the working folder, too, but there last, so that it cannot shadow ours."""
    if module.endswith(".py") or module.startswith(".") or "/" in module:
        kind, right = "file" if module.endswith(".py") else "path", _module_name(Path(module))
        fix = f"give the module's name, not its {kind}: {right}:{env_id.rpartition(':')[2]}"
        raise ConfigError("ENV", env_id, f"{fix}, from the folder that holds {right.partition('.')[0]}")
    folder = os.getcwd()
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        ours = error.name is not None and (module == error.name or module.startswith(f"{error.name}."))
        fix = f"start from the folder that holds {module}" if ours else f"{module} needs it; install it"
        fault = _shadow_fault(module) if ours else None
        raise ConfigError("ENV", env_id, fault or f"{error}; {fix}") from None
    except PASSED_ON:
        raise
    except BaseException as error:
        raise ConfigError("ENV", env_id, f"{module} cannot be imported: {describe_error(error)}") from None


def _import_tasks(env_id: str, packages: tuple[str, str], module: str, how: str) -> None:
    """Tasks are gymnasium's once a module is imported. Raises ConfigError where a package is missing."""
    if not all(map(importlib.util.find_spec, packages)):
        raise ConfigError("ENV", env_id, f"{' or '.join(packages)} is missing; {how}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # shimmy looks for a screen, and says so where there is none
        try:
            importlib.import_module(module)
        except PASSED_ON:
            raise
        except BaseException as error:  # of dm_control, where MUJOCO_GL names no renderer
            raise ConfigError("ENV", env_id, f"{module} cannot be imported: {describe_error(error)}") from None
