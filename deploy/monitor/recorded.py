"""The state of a run out of its folder: of any version, also a baseline's, whether or not it is trained now."""

import json
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, TypeGuard

from rmc.common.bus.metrics_record import is_finite
from rmc.common.errors import ConfigError
from rmc.deploy.monitor.notices import notices
from rmc.deploy.monitor.run_status import RunStatus
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.metrics_tail import RECENT_BYTES, MetricsTail
from rmc.deploy.run.starts import starts
from rmc.deploy.run.state import run_state

Callback = Callable[[dict[str, Any]], object]  # hears a record, as a line of metrics.jsonl has it


def recorded_status(folder: RunFolder, recent_bytes: int = RECENT_BYTES) -> RunStatus:
    """As its metrics say. Raises ConfigError where the folder is no run's or is damaged."""
    status = empty_status(folder)
    take_state(status, folder)
    catch_up(status, MetricsTail(folder.metrics, recent_bytes))
    return status


def take_state(status: RunStatus, folder: RunFolder) -> None:
    """Take in what has become of the run. Raises ConfigError where that is damaged."""
    status.state = run_state(folder)
    take_start(status, folder)
    result = folder.result() if status.state == "finished" else None
    status.final_steps = None if result is None else int(result["env_steps"])


def take_start(status: RunStatus, folder: RunFolder) -> None:
    """Take in when the run was started last: who spoke before need not speak now, nor who speaks on another machine."""
    if folder.lock.is_on_ray():
        status.heard = ""
    status.began = max((start.time for start in starts(folder)[-1:] if is_finite(start.time)), default=0.0)


def status_json(folder: RunFolder, status: RunStatus) -> dict[str, Any]:
    """All of it as ``rmc stats --json`` prints it; a number that JSON has not, like infinity, is null."""
    shown = {
        "run": str(folder.path),
        "state": status.state,
        "env": status.env,
        "preset": status.preset,
        "seed": status.seed,
        "env_steps": status.env_steps,
        "total_steps": status.total_steps,
        "share_done": status.share_done,
        "elapsed_s": status.elapsed_s,
        "eta_s": status.eta_s,
        "last_evaluation": status.last and asdict(status.last),
        "best_evaluation": status.best and asdict(status.best),
        "notices": notices(status),
        "roles": status.roles,
        "result": folder.result(),
    }
    plain: dict[str, Any] = json.loads(json.dumps(shown), parse_constant=lambda _: None)
    return plain


def catch_up(status: RunStatus, tail: MetricsTail, callback: Callback | None = None) -> None:
    """Take in what is new; ``callback`` hears it."""
    for record in tail.take():
        status.take(record)
        if callback is not None:
            callback(record)


def empty_status(folder: RunFolder, expected: tuple[str, ...] = ()) -> RunStatus:
    """By ``config.json`` and the steps that the run had at its newest start. Raises ConfigError."""
    settings = folder.settings()
    env = _part(settings, "env").get("id")
    preset = str(settings.get("preset") or f"{settings.get('algorithm')}-{settings.get('settings')}")
    seed, total = settings.get("seed"), settings.get("total_steps")
    ratio = _part(settings, "replay").get("replay_ratio", 0.0)
    if not (_is_shown(env) and _is_shown(preset) and _is_int(seed) and _is_int(total) and is_finite(ratio)):
        fix = "config.json has no env, seed or total_steps; restore it, or take another run"
        raise ConfigError("RUN", str(folder.path), fix)
    status = RunStatus(env, preset, seed, total, ratio, expected)
    status.steps_before = max((start.env_steps for start in starts(folder)[-1:]), default=0)
    if folder.is_baseline():
        status.heard, status.steps_before = "launcher", 0  # a killed one goes on from long before
    return status


def _is_shown(value: Any) -> TypeGuard[str]:
    return isinstance(value, str) and value.isprintable()


def _is_int(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and is_finite(value)


def _part(settings: dict[str, Any], name: str) -> dict[str, Any]:
    part = settings.get(name, {})
    return part if isinstance(part, dict) else {}
