"""What ``config.json`` of an older version says, in the words of this one.

``format`` in the file counts its changes: the version of the distribution does not, as it may stay while options come.
Files without it are of format 1. An option that came later takes the value that keeps what older runs did.
"""

from collections.abc import Callable
from typing import Any

from rmc.common.errors import ConfigError

Raw = dict[str, Any]


def _to_2(raw: Raw) -> None:
    _add(raw, "env", env_kwargs={})
    _add(raw, "evaluator", evaluation_seconds=0.0)  # no evaluation was cut
    _rename(raw, "agent", fill_blanks="impute_missing", blank_flag="missing_flag")
    _rename(raw, "update", policy_average="policy_ema_updates")


def _to_3(raw: Raw) -> None:
    _add(raw, "env", drop_sensors=0.0, flicker_burst=1.0, delay=0)
    _add(raw, "agent", gate_init="uniform", privileged_critic=False)
    _add(raw, "layout", missing=1, privileged=0)  # in a policy's file; flags were one for a whole frame


def _to_4(raw: Raw) -> None:
    _remove(raw, "agent", critic_norm=False)
    _add(raw, "agent", critic_batch_norm=False)


def _to_5(raw: Raw) -> None:
    _add(raw, "update", policy_delay=1)


def _to_6(raw: Raw) -> None:
    _remove(raw, "agent", layer_norm=False)


def _to_7(raw: Raw) -> None:
    _add(raw, "update", target_entropy=-1.0)


MIGRATIONS: list[Callable[[Raw], None]] = [_to_2, _to_3, _to_4, _to_5, _to_6, _to_7]  # the first is from format 1 to 2
FORMAT = 1 + len(MIGRATIONS)


def migrated(raw: Raw) -> Raw:
    """The same in this version's words, without its ``format``. Raises ConfigError for a newer format."""
    settings = {name: dict(part) if isinstance(part, dict) else part for name, part in raw.items()}
    was = settings.pop("format", 1)
    if type(was) is not int or was < 1:
        raise ConfigError("config.json format", was, "must be a number from 1; restore the file or start a new run")
    if was > FORMAT:
        fix = f"written by a newer version of RMC, this one reads up to {FORMAT}; update RMC to use this run"
        raise ConfigError("config.json format", was, fix)
    for migrate in MIGRATIONS[was - 1 :]:
        migrate(settings)
    return settings


def _add(raw: Raw, part: str, **options: Any) -> None:
    if isinstance(raw.get(part), dict):
        raw[part] = options | raw[part]


def _rename(raw: Raw, part: str, **names: str) -> None:
    if isinstance(raw.get(part), dict):
        raw[part] = {names.get(name, name): value for name, value in raw[part].items()}


def _remove(raw: Raw, part: str, **options: Any) -> None:
    """Options that are gone, each with the value that does what this version does. Raises ConfigError for others."""
    if not isinstance(settings := raw.get(part), dict):
        return
    for name, value in options.items():
        if (was := settings.pop(name, value)) != value:
            fix = "this version has no such option; use the version of RMC that wrote it"
            raise ConfigError(f"{part}.{name}", was, fix)
