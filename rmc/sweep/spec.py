"""What a sweep is asked to run, from a file or from the command line, before any of it is checked as an option.

SPEC.toml: ``env``, one or a list, ``seeds``, ``[options]`` that every run has, and ``[grid]`` or ``[search]``.
"""

import json
import re
from collections.abc import Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rmc.common.bus.metrics_record import is_finite
from rmc.common.bus.redis_url import value_without_passwords
from rmc.common.env.config import EnvConfig, check_kwargs, typed
from rmc.common.errors import ConfigError
from rmc.deploy.run.option_names import did_you_mean, flag, flat, option, plain_names, read_toml
from rmc.deploy.run.presets import robust

KEYS = ("env", "seeds", "options", "grid", "search")
SEARCH_KEYS = ("trials", "sampler_seed", "prune", "ranges")
RANGE_KEYS = ("low", "high", "log")
SEEDS_FIX = 'write whole numbers, like [1, 2, 3] or "1-5"'
OWN = {"id", "seed"}  # that a sweep gives each run itself
NAMES = {path.rpartition(".")[2] for path in flat(robust(EnvConfig("")))} - OWN | {
    "launcher",
    "device",
    "init_from",
    "init_parts",
}
EVERY_RUNS = NAMES | {"track", "track_project", "track_tags", "video_every"}  # which no two runs differ in
RUN_LAUNCHERS = ("local", "lockstep")
MOST = 1_000_000  # runs and trials


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``, both included; whole ones where the option's are."""

    low: float
    high: float
    log: bool = False

    def __repr__(self) -> str:
        return f"{self.low}..{self.high}{':log' * self.log}"


@dataclass(frozen=True)
class Search:
    """Options and where their values are looked for: a range, or a list of choices."""

    ranges: dict[str, Range | list[Any]]
    trials: int = 20
    sampler_seed: int = 0
    prune: bool = True

    def ends(self) -> dict[str, list[Any]]:
        """The values to be checked: both ends of a range, or all choices."""
        return {name: [one.low, one.high] if isinstance(one, Range) else one for name, one in self.ranges.items()}


@dataclass(frozen=True)
class Spec:
    """A sweep."""

    envs: tuple[str, ...]
    seeds: tuple[int, ...] = (0,)
    options: dict[str, Any] = field(default_factory=dict)
    grid: dict[str, list[Any]] = field(default_factory=dict)
    search: Search | None = None
    words: tuple[str, ...] = ()  # options of rmc train, as they were typed

    def __post_init__(self) -> None:
        """Raises ConfigError for names and lists that make no sense; values are judged by the parser of rmc train."""
        _check_envs(self.envs)
        for name, value in self.options.items():
            check_name(f"options.{name}", name, value, EVERY_RUNS)
        for name, values in self.grid.items():
            check_name(f"grid.{name}", name, values)
            if not isinstance(values, list) or not values:
                raise ConfigError(f"grid.{name}", values, "write a list of values, like [3e-4, 1e-3]")
            _check_each_once(f"grid.{name}", values)
        if self.search is not None:
            self._check_search(self.search)
        varied = {**self.grid, **(self.search.ranges if self.search else {})}
        given = [word.lstrip("-").partition("=")[0].replace("-", "_") for word in self.words if word.startswith("--")]
        for name in [*self.options, *given]:
            if (plain := name.removeprefix("no_")) in varied:
                raise ConfigError(name, varied[plain], "is an option of every run and varied, too; leave one of them")

    def said(self) -> set[str]:
        """The options that are typed, that every run has, or that are varied."""
        varied = self.search.ranges if self.search else {}
        return {*map(flag, self.words), *map(option, (*self.options, *self.grid, *varied))}

    def _check_search(self, search: Search) -> None:
        if self.grid:
            raise ConfigError("grid", sorted(self.grid), "a sweep has a grid or a search; leave one of them")
        if len(self.envs) != 1:
            raise ConfigError("env", list(self.envs), "a search has one; start one for each")
        if len(self.seeds) != 1:
            raise ConfigError("seeds", list(self.seeds), "a search has one; repeat its best with more as a grid")
        if not search.ranges:
            raise ConfigError("search.ranges", {}, "name options, like learning_rate = {low = 1e-5, high = 1e-2}")
        if not 1 <= search.trials <= MOST:
            raise ConfigError("search.trials", search.trials, f"take 1 to {MOST:_}")
        if not 0 <= search.sampler_seed < 2**31:
            raise ConfigError("search.sampler_seed", search.sampler_seed, "take 0 to 2147483647")
        for name, values in search.ranges.items():
            check_name(f"search.{name}", name, values)
            if isinstance(values, list) and not values:
                raise ConfigError(f"search.{name}", values, "write a list of choices, or a range")
            if isinstance(values, list):
                _check_each_once(f"search.{name}", values)


def _check_envs(envs: tuple[str, ...]) -> None:
    if not envs or not all(isinstance(env, str) and env for env in envs):
        raise ConfigError("env", list(envs), 'write ENV,ENV, or in a file env = "HalfCheetah-v5" or a list of them')
    _check_each_once("env", list(envs))


def _check_each_once(place: str, values: list[Any]) -> None:
    if len({repr(value) for value in values}) < len(values):
        raise ConfigError(place, values, "has a value twice; give each once, and lists in brackets")


def check_name(place: str, name: str, value: Any, names: Set[str] = NAMES) -> None:
    """Raises ConfigError where that is no option that a sweep's runs may have."""
    told = value_without_passwords(value)
    if name == "env":
        raise ConfigError(place, told, "give ENV,ENV in place of ENV, or in a file env = [ENV, ENV]")
    if name in OWN:
        raise ConfigError(place, told, "every run has its own; give env and seeds")
    if name not in names:
        hint = did_you_mean(name, names, "; rmc train --help-all lists them")
        raise ConfigError(place, told, f"no option that a sweep's runs take{hint}")
    for one in value if isinstance(value, list) else [value]:
        if name == "env_kwargs" and isinstance(one, dict):
            check_kwargs(one)
        if name == "launcher" and one not in RUN_LAUNCHERS:
            fix = f"a run's is {' or '.join(RUN_LAUNCHERS)}; --launcher ray spreads whole runs"
            raise ConfigError(place, one, fix)


def read_spec(path: Path, words: Sequence[str]) -> Spec:
    """A sweep from its file. Raises ConfigError, which names the key."""
    raw = read_toml("SPEC", path, "give a .toml file or an environment")
    _check_keys("", raw, KEYS)
    for part in ("options", "grid", "search"):
        if not isinstance(raw.get(part, {}), dict):
            raise ConfigError(part, raw[part], f"write it as a table, [{part}]")
    search = _search(raw["search"]) if "search" in raw else None
    seeds = read_seeds(raw.get("seeds", 0))
    options, grid = (plain_names(f"{part}.", raw.get(part, {})) for part in ("options", "grid"))
    envs = raw.get("env", [])
    return Spec(tuple(envs) if isinstance(envs, list) else (envs,), seeds, options, grid, search, tuple(words))


def _check_keys(place: str, raw: dict[str, Any], names: Sequence[str]) -> None:
    for name, value in raw.items():
        if name not in names:
            hint = did_you_mean(name, names, f"; use {', '.join(names)}")
            raise ConfigError(f"{place}{name}", value, f"no such key{hint}")


def _search(raw: dict[str, Any]) -> Search:
    _check_keys("search.", raw, SEARCH_KEYS)
    kinds = {"trials": int, "sampler_seed": int, "prune": bool, "ranges": dict}
    for name, value in raw.items():
        if type(value) is not kinds[name]:
            expected = {int: "a whole number", bool: "true or false", dict: "a table, [search.ranges]"}[kinds[name]]
            raise ConfigError(f"search.{name}", value, f"write {expected}")
    ranges = {name: _range(f"search.{name}", value) for name, value in raw.get("ranges", {}).items()}
    return Search(**{**raw, "ranges": plain_names("search.", ranges)})


def _range(place: str, raw: Any) -> Range | list[Any]:
    if isinstance(raw, list):
        return raw
    if not isinstance(raw, dict) or not raw.keys() >= {"low", "high"}:
        raise ConfigError(place, raw, "write {low = 1e-5, high = 1e-2, log = true}, or a list of choices")
    _check_keys(f"{place}.", raw, RANGE_KEYS)
    return _checked_range(place, raw["low"], raw["high"], raw.get("log", False))


def _checked_range(place: str, low: Any, high: Any, log: Any) -> Range:
    numbers = is_finite(low) and is_finite(high)
    if not numbers or type(log) is not bool or not low < high:
        fix = "low and high are numbers, low below high, log is true or false"
        raise ConfigError(place, {"low": low, "high": high, "log": log}, fix)
    if log and low <= 0:
        raise ConfigError(place, low, "a logarithmic range begins above 0")
    return Range(low, high, log)


def read_seeds(raw: Any) -> tuple[int, ...]:
    """Of a list of whole numbers, of one, or of words like ``1-3,7``. Raises ConfigError."""
    if isinstance(raw, str):
        ends = [re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip()) for part in raw.split(",")]
        pairs = [(int(match[1]), int(match[2] or match[1])) for match in ends if match]
        if len(pairs) < len(ends) or any(not 0 <= high - low < MOST for low, high in pairs):
            raise ConfigError("seeds", raw, f"{SEEDS_FIX}, {MOST:_} at most")
        seeds = [seed for low, high in pairs for seed in range(low, high + 1)]
    else:
        seeds = raw if isinstance(raw, list) else [raw]
    if not seeds or any(type(seed) is not int for seed in seeds) or len(set(seeds)) < len(seeds):
        raise ConfigError("seeds", raw, f"{SEEDS_FIX}, each once")
    return tuple(seeds)


def read_grid(words: Sequence[str]) -> dict[str, list[Any]]:
    """Of ``NAME=VALUE,VALUE…`` words. Raises ConfigError."""
    return {name: read_values(text) for name, text in _pairs("--grid", words)}


def read_ranges(words: Sequence[str]) -> dict[str, Range | list[Any]]:
    """Of ``NAME=LOW..HIGH``, ``NAME=LOW..HIGH:log`` or ``NAME=CHOICE,CHOICE…`` words. Raises ConfigError."""
    ranges: dict[str, Range | list[Any]] = {}
    for name, text in _pairs("--search", words):
        ends = re.fullmatch(r"([^,]+?)\.\.([^,]+?)(:log)?", text)
        if ends is not None:
            ranges[name] = _checked_range(f"search.{name}", _number(ends[1]), _number(ends[2]), bool(ends[3]))
            continue
        ranges[name] = read_values(text)
        if re.match(r"[-+.]?\d", text) and ranges[name] == [text]:  # a range that is written in another way
            raise ConfigError(f"search.{name}", text, "write LOW..HIGH, LOW..HIGH:log, or choices with commas between")
    return ranges


def _number(text: str) -> Any:
    """As every option reads one, else the text."""
    for read in (int, float):
        with suppress(ValueError):
            return read(text)
    return text


def _pairs(option: str, words: Sequence[str]) -> list[tuple[str, str]]:
    pairs = []
    for word in words:
        name, equals, text = word.partition("=")
        if not (name and equals and text):
            raise ConfigError(option, word, "write NAME=VALUE,VALUE…, like learning_rate=3e-4,1e-3")
        pairs.append((name.replace("-", "_"), text))
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names):
        raise ConfigError(option, " ".join(words), "has an option twice; give all of its values after one name")
    return pairs


def read_values(text: str) -> list[Any]:
    """Values between commas: numbers, true, false, words; lists in brackets."""
    try:
        values: list[Any] = json.loads(f"[{text}]")
    except ValueError:
        values = [typed(part) for part in text.split(",")]
    return values
