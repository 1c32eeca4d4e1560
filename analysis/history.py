"""What runs went through: their evaluations over agent steps, updates and wall time, read from their folders.

A file of JSON lines holds many, one a line, so that results can be kept without their runs.
"""

import dataclasses
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from rmc.analysis import baseline_settings
from rmc.common.bus.metrics_record import is_complete, is_finite
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.opening import SAME_AGENT
from rmc.deploy.run.option_names import changes, flat, option
from rmc.deploy.run.presets import preset_config
from rmc.deploy.run.starts import begun_with, starts
from rmc.deploy.run.state import remedy

OMITTED = SAME_AGENT | {"seed", "preset", "env.id"}  # makes no other agent


@dataclass(frozen=True)
class Evaluation:
    """Deterministic episodes of one checkpoint."""

    env_steps: int
    updates: int
    wall_s: float
    return_mean: float
    return_std: float


@dataclass(frozen=True)
class History:
    """One run. ``agent`` and ``env`` say all that tells it from others but its seed."""

    agent: str
    env: str
    seed: int
    env_steps: int
    updates: int
    wall_s: float
    initial_return: float | None
    evaluations: list[Evaluation] = field(default_factory=list)
    finished: bool = False  # then the last evaluation is the result's, unless that was cut
    commit: str = field(default="", compare=False)

    def to_line(self) -> str:
        """As one line of JSON."""
        return json.dumps(dataclasses.asdict(self))


def read_histories(path: Path) -> list[History]:
    """The histories in a run's folder, or in a file of lines. Raises ConfigError."""
    if path.is_dir():
        return [of_run(RunFolder(path))]
    return [_of_line(line, place) for place, line in objects(path, "evaluations").items()]


def objects(path: Path, *names: str) -> dict[str, dict[str, Any]]:
    """What a file of JSON lines holds, by PATH:LINE, each with these ``names``. Raises ConfigError."""
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise ConfigError("RUNS", str(path), f"{error.strerror}; give runs' folders or files of JSON lines") from None
    return {f"{path}:{i}": _object(line, f"{path}:{i}", names) for i, line in enumerate(lines, 1) if line.strip()}


def _object(line: bytes, place: str, names: Sequence[str]) -> dict[str, Any]:
    try:
        value = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ConfigError("RUNS", place, f"not JSON ({error}); fix the line, or remove it") from None
    if not isinstance(value, dict) or not value.keys() >= set(names):
        raise ConfigError("RUNS", place, f"must be an object with {', '.join(names)}; fix the line, or remove it")
    return value


def _of_line(raw: dict[str, Any], place: str) -> History:
    try:
        known = {name: value for name, value in raw.items() if name != "transitions"}  # of older lines
        history = History(**{**known, "evaluations": [Evaluation(**one) for one in raw["evaluations"]]})
    except TypeError as error:
        raise ConfigError("RUNS", place, f"not a history ({error}); fix the line, or remove it") from None
    numbers: list[Any] = [history.seed, history.env_steps, history.updates, history.wall_s]
    numbers += [] if history.initial_return is None else [history.initial_return]
    numbers += [value for one in history.evaluations for value in dataclasses.astuple(one)]
    texts = history.agent, history.env, history.commit
    named = all(isinstance(text, str) and text.isprintable() for text in texts) and isinstance(history.finished, bool)
    if not (history.evaluations and all(map(is_finite, numbers)) and named):
        fix = "not a history (its evaluations, numbers and names); fix the line, or remove it"
        raise ConfigError("RUNS", place, fix)
    return history


def of_run(folder: RunFolder) -> History:
    """A run's, finished or not. Raises ConfigError where it is none, or was not evaluated yet.

    Evaluations are left out that were cut, or in which an episode broke.
    """
    about = describe(folder.path)
    evaluations = _evaluations(filter(is_complete, folder.records()))
    result, initial = folder.result() or {}, folder.initial() or {}
    if result and is_complete(result):
        ours = not folder.is_baseline()  # whose last checkpoint was also played while it trained
        below = result["env_steps"], result["updates"] if ours else math.inf
        evaluations = [one for one in evaluations if one.env_steps < below[0] and one.updates < below[1]]
        mean, std = result["eval_return_mean"], result["eval_return_std"]
        evaluations.append(Evaluation(result["env_steps"], result["updates"], result["wall_s"], mean, std))
    if not evaluations:
        fix = f"it has no evaluation yet that was played to its end; {remedy(folder)}"
        raise ConfigError("RUNS", str(folder.path), fix)
    last = dataclasses.asdict(evaluations[-1]) | result
    return History(
        about.agent,
        about.env,
        about.seed,
        last["env_steps"],
        last["updates"],
        last["wall_s"],
        result.get("initial_return_mean", initial.get("eval_return_mean")) if is_complete(initial) else None,
        evaluations,
        bool(result),
    )


@dataclass(frozen=True)
class About:
    """What a run is, from its ``config.json``."""

    agent: str
    env: str
    seed: int


def describe(path: Path) -> About:
    """Of a run of RMC, or of a baseline. Raises ConfigError."""
    folder = RunFolder(path)
    if folder.is_baseline():
        baseline = baseline_settings.read_config(folder)
        return About(" ".join([baseline.name, *_stack(baseline.env)]), baseline.env.label(), baseline.seed)
    config = folder.config()
    name = "RMC" if config.preset == "robust" else f"RMC {config.preset}"
    agent = " ".join([name, *_changes(config, folder), *_stack(config.env), *_warm_start(folder)])
    return About(agent, config.env.label(), config.seed)


def _changes(config: RunConfig, folder: RunFolder) -> list[str]:
    """Options that differ from the preset's, as they are typed, and those that a resume has changed."""
    changed = changes(preset_config(config.preset, config.env), config)
    words = {path: _typed(path, now) for path, (_, now) in changed.items()}
    words |= {path: f"{option(path)} {' then '.join(map(str, had))}" for path, had in _resumed(config, folder).items()}
    return [text for path, text in words.items() if path not in OMITTED]


def _resumed(config: RunConfig, folder: RunFolder) -> dict[str, list[Any]]:
    """By the path of an option that a resume has changed, the values that it had, one after the other."""
    past: dict[str, list[Any]] = {}
    for start in starts(folder):
        if start.env_steps:  # before the first step nothing was trained with it
            for path, (before, _) in start.changes.items():
                past.setdefault(path, []).append(before)
    now = flat(config)
    had = {path: [value for value, _ in groupby([*values, now[path]])] for path, values in past.items() if path in now}
    return {path: values for path, values in had.items() if len(values) > 1}


def _warm_start(folder: RunFolder) -> list[str]:
    """The run that it began with, where it did not begin anew."""
    begun = begun_with(folder)
    if not begun:
        return []
    run, number, parts = (begun[name] for name in ("run", "checkpoint", "parts"))
    return [f"--init-from {run}:{number}", *([f"--init-parts {parts}"] if parts != "all" else [])]


def _typed(path: str, value: Any) -> str:
    if isinstance(value, bool):
        return option(path) if value else option(path).replace("--", "--no-", 1)
    return f"{option(path)} {' '.join(map(str, value)) if isinstance(value, tuple) else value}"


def _stack(env: EnvConfig) -> list[str]:
    """A stack of frames belongs to the agent: what there is to see is the same."""
    return [f"--frame-stack {env.frame_stack}"] if env.frame_stack > 1 else []


def _evaluations(records: Iterable[dict[str, Any]]) -> list[Evaluation]:
    """In order of agent steps. A run that went back to an earlier checkpoint has lost what it made after it."""
    steps, said = {}, []  # all that is kept of a long run
    for record in records:
        if _says(record, "learner", "updates", "env_steps"):
            steps[record["updates"]] = record["env_steps"]
        elif _says(record, "launcher", "time", "wall_s"):
            said.append({name: record[name] for name in ("role", "time", "wall_s")})
        elif _says(record, "evaluator", "time", "eval_update", "eval_return_mean", "eval_return_std"):
            said.append(record)
    evaluations: list[Evaluation] = []
    played = [(record, wall) for record, wall in zip(said, wall_seconds(said), strict=True) if "wall_s" not in record]
    places = _between([record["eval_update"] for record, _ in played], steps)
    for (record, wall), place in zip(played, places, strict=True):
        updates, own = record["eval_update"], _says(record, "evaluator", "eval_env_steps")
        at = int(record["eval_env_steps"] if own else place)  # older runs say the update alone
        while evaluations and evaluations[-1].env_steps >= at:
            evaluations.pop()
        evaluations.append(Evaluation(at, updates, wall, record["eval_return_mean"], record["eval_return_std"]))
    return evaluations


def wall_seconds(records: Sequence[dict[str, Any]]) -> list[float]:
    """Seconds trained when each was written, over all starts, by what the launcher says before and after it.

    Not by time alone: a clock may go back between two starts. ``records``, each with a ``time``, are in the file's
    order, in which one may come a moment late.
    """
    clock = [(one["time"], one["wall_s"]) for one in records if _says(one, "launcher", "time", "wall_s")]
    known, seconds, before = clock or [(0.0, 0.0)], [], 0
    for record in records:
        before += _says(record, "launcher", "time", "wall_s")
        time, wall = known[max(before - 1, 0)]
        least, most = known[before - 2][1] if before > 1 else 0.0, known[min(before, len(known) - 1)][1]
        seconds.append(min(max(least, wall + record["time"] - time), most))
    return seconds


def _says(record: dict[str, Any], role: str, *names: str) -> bool:
    """Whether it is that role's and has all of these, as finite numbers: half of an evaluation is none."""
    return record.get("role") == role and all(is_finite(record.get(name)) for name in names)


def _between(at: list[float], points: dict[Any, Any]) -> list[float]:
    """What lies at each of ``at`` on the line through the points that are known."""
    places = sorted(points)
    values = np.interp(at, places, [points[place] for place in places]) if places else np.zeros(len(at))
    on_line: list[float] = values.tolist()
    return on_line
