"""``--config FILE.toml``: options of ``rmc train`` in a file; those of the command line win."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rmc.common.bus.redis_url import value_without_passwords
from rmc.common.env.config import check_kwargs, write_kwargs
from rmc.common.errors import ConfigError
from rmc.common.user_path import user_path
from rmc.deploy.run.option_names import did_you_mean, flag, option_words, plain_names, read_toml

RENAMED = {
    "fill-blanks": "impute-missing",
    "blank-flag": "missing-flag",
    "policy-average": "policy-ema-updates",
}  # for one more version
OPTION, KWARGS = "--config", "--env-kwargs"


def with_file(words: list[str], names: Sequence[str]) -> tuple[list[str], str]:
    """The words with the options of the file that they name, if any, before their own; and the file's ENV.

    ``names`` are those of all options. Raises ConfigError.
    """
    path = named(words)
    if path is None:
        return words, ""
    env, options = read_options(path, names)
    kwargs = options.pop("env_kwargs", {})
    file_words = [word for name, value in options.items() for word in option_words(name, value)]
    if any(flag(word) == KWARGS for word in words):
        kwargs = {}
    last = [KWARGS, *write_kwargs(kwargs)] if kwargs else []
    own = words[1:]
    first = list(itertools.takewhile(lambda word: not word.startswith("-"), own))  # ENV: a list would take it in
    return [words[0], *first, *file_words, *own[len(first) :], *last], env


def named(words: Sequence[str]) -> Path | None:
    """The file, if there is one. Raises ConfigError where there are two."""
    paths = [user_path(value) for value in option_values(OPTION, words)]
    if len(paths) > 1:
        raise ConfigError(OPTION, " ".join(map(str, paths)), "is there twice; give one file")
    return paths[0] if paths else None


def without_file(words: Sequence[str]) -> list[str]:
    """The words that do not name it."""
    kept, left = [], iter(words)
    for word in left:
        name, equals, _ = word.partition("=")
        if name != OPTION:
            kept.append(word)
        elif not equals:
            next(left, None)
    return kept


def read_options(path: Path, names: Sequence[str]) -> tuple[str, dict[str, Any]]:
    """The file's ENV, and its options by their names in Python. Raises ConfigError."""
    options = plain_names(f"{OPTION} {path}: ", read_toml(OPTION, path, "give a TOML file"), RENAMED)
    env, kwargs = options.pop("env", ""), options.get("env_kwargs", {})
    if not isinstance(env, str):
        raise ConfigError(f"{OPTION} {path}: env", env, 'write the environment\'s id, like env = "HalfCheetah-v5"')
    if not isinstance(kwargs, dict):
        raise ConfigError(f"{OPTION} {path}: env_kwargs", kwargs, "write a table, like env_kwargs = { goal = 1.5 }")
    check_kwargs(kwargs)
    for name, value in options.items():
        if name != "env_kwargs":
            _check(path, name, value, names)
    return env, options


def option_values(option: str, words: Sequence[str]) -> list[str]:
    """What an option is given, in its order, as ``--option VALUE`` or ``--option=VALUE``."""
    pairs = itertools.zip_longest(words, words[1:])
    found = (word.partition("=")[2] if "=" in word else after for word, after in pairs if flag(word) == option)
    return [value for value in found if value is not None]


def _check(path: Path, name: str, value: Any, names: Sequence[str]) -> None:
    told = value_without_passwords(value)
    if name not in names:
        fix = did_you_mean(name, names, "; rmc train --help-all lists them")
        raise ConfigError(f"{OPTION} {path}: {name}", told, f"is no option{fix}")
    if not all(isinstance(one, str | bool | int | float) for one in (value if isinstance(value, list) else [value])):
        raise ConfigError(f"{OPTION} {path}: {name}", told, "give a number, text, true, false or a list of such")
