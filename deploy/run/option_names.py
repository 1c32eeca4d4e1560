"""What options are called: as a path in a config, on the command line and in a file."""

import dataclasses
import difflib
import tomllib
import types
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rmc.common.env.config import write_kwargs
from rmc.common.errors import ConfigError

POSITIONAL = {"env.id": "ENV", "algorithm": "ALGORITHM"}


def flat(config: Any, prefix: str = "") -> dict[str, Any]:
    """The values of a config, or of what JSON holds of one, by dotted path."""
    values: dict[str, Any] = {}
    for name, value in (config if isinstance(config, dict) else dataclasses.asdict(config)).items():
        nested = isinstance(value, dict) and name != "env_kwargs"
        values |= flat(value, f"{prefix}{name}.") if nested else {prefix + name: value}
    return values


def changes(was: Any, now: Any) -> dict[str, list[Any]]:
    """Of two configs of a kind: by the option's path, what it was and is."""
    before, after = flat(was), flat(now)
    return {path: [before[path], after[path]] for path in after if before[path] != after[path]}


def option(path: str) -> str:
    """The command line's name of a config path, which is ``--replay-ratio`` for ``replay.replay_ratio``."""
    return POSITIONAL.get(path) or "--" + path.rpartition(".")[2].replace("_", "-")


def flag(word: str) -> str:
    """The option that a typed word names, ``--replay-ratio`` for ``--replay_ratio=96``; another word as it is."""
    return word.partition("=")[0].replace("_", "-")


def did_you_mean(word: str, known: Iterable[str], otherwise: str = "") -> str:
    """The end of a message on a word that is not known: what is most like it, or ``otherwise``."""
    plain, names = word.lstrip("-"), {name.lstrip("-"): name for name in known}
    longer = (name for name in names if len(plain) > 1 and name.startswith(plain))
    near = difflib.get_close_matches(plain, names, 1, cutoff=0.7) or list(longer)
    return f"; did you mean {names[near[0]]}?" if near else otherwise


def read_toml(option: str, path: Path, fix: str) -> dict[str, Any]:
    """What the file that ``option`` names holds. Raises ConfigError, with ``fix`` where no file can be read."""
    try:
        return tomllib.loads(path.read_bytes().decode())
    except OSError as error:
        raise ConfigError(option, str(path), f"cannot be read ({error.strerror}); {fix}") from None
    except ValueError as error:  # no TOML, or no UTF-8
        raise ConfigError(option, str(path), f"is not TOML ({error}); fix it") from None


def plain_names(
    place: str, raw: Mapping[str, Any], renamed: Mapping[str, str] = types.MappingProxyType({})
) -> dict[str, Any]:
    """What a file says of options, by their present names. Raises ConfigError where one is at ``place`` twice."""
    written: dict[str, str] = {}
    for name in raw:
        dashed = name.replace("_", "-")
        plain = renamed.get(dashed, dashed).replace("-", "_")
        if plain in written:
            raise ConfigError(f"{place}{plain}", [written[plain], name], "is there twice; leave one of them")
        written[plain] = name
    return {plain: raw[name] for plain, name in written.items()}


def option_words(name: str, value: Any) -> list[str]:
    """An option as it is given on the command line."""
    if isinstance(value, bool):
        return [option(name) if value else option(f"no_{name}")]
    if isinstance(value, dict):
        return [option(name), *write_kwargs(value)]
    return [option(name), *map(str, value)] if isinstance(value, list) else [f"{option(name)}={value}"]
