"""Every start of a run, a line each in its folder's ``history.jsonl``: when, by which version, what changed."""

import dataclasses
import json
import os
import shlex
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any, get_type_hints

from rmc.common.bus.metrics_record import is_finite
from rmc.common.bus.redis_url import has_password, redacted
from rmc.common.checkpoint import PROGRESS
from rmc.common.errors import ConfigError
from rmc.common.user_path import user_path
from rmc.deploy.run.config import from_dict, value_of_kind
from rmc.deploy.run.folder import RunFolder, read_object
from rmc.deploy.run.launch_options import Launcher, LaunchOptions
from rmc.deploy.run.metrics_tail import LISTED_BYTES, MetricsTail
from rmc.deploy.run.option_names import option

KEPT = (  # of how a run was started last
    "launcher", "device", "redis_url", "ray_address", "all_cpus", "tls", "metrics_port", "metrics_host",
)  # fmt: skip


@dataclass(frozen=True)
class Start:
    """One of a run's starts."""

    time: float
    version: str
    env_steps: int  # that the run had then
    changes: dict[str, list[Any]] = field(default_factory=dict)  # what it was and is, by the option's path
    launch: dict[str, Any] = field(default_factory=dict)
    init_from: dict[str, Any] | None = None  # at the first start: run, checkpoint and parts


DEFAULTS: dict[str, Any] = {"changes": {}, "launch": {}, "init_from": None}


def note_start(
    folder: RunFolder, changes: dict[str, list[Any]], options: LaunchOptions, init_from: dict[str, Any] | None
) -> None:
    """Add a line that is on the disk before the run goes on. Raises OSError."""
    launch = {name: getattr(options, name) for name in KEPT}
    if (url := options.redis_url) is not None and has_password(url):
        launch["redis_url"] = redacted(url)  # it must be said again: that Redis refuses who names no password
    elif url is not None and url.startswith("file:"):  # it may go on elsewhere
        launch["redis_url"] = f"file:{user_path(url.removeprefix('file:')).absolute()}"
    start = Start(time.time(), version("rmc-rl"), _env_steps(folder), changes, launch, init_from)
    path = folder.history_file
    torn = path.exists() and not path.read_bytes().endswith(b"\n")  # by a crash
    with path.open("a") as file:
        file.write("\n" * torn + json.dumps(asdict(start)) + "\n")
        file.flush()
        os.fsync(file.fileno())


def _env_steps(folder: RunFolder) -> int:
    """That the run has, by its newest checkpoint and what its roles said last."""
    newest: dict[str, int] = {}
    for record in MetricsTail(folder.metrics, LISTED_BYTES).take():
        if record["role"].startswith(("learner", "replay")) and is_finite(record.get("env_steps")):
            newest[record["role"]] = int(record["env_steps"])
    learner, saved = newest.pop("learner", 0), 0
    for progress in sorted(folder.checkpoints.glob(f"[0-9]*/{PROGRESS}"))[-1:]:
        with suppress(OSError, ConfigError):  # damaged, it is as none
            saved = int(read_object(progress, "env_steps")["env_steps"])
    if (folder.path / "config.json").exists() and folder.is_baseline():  # which goes back to what it saved
        return saved
    return max(learner, saved, sum(newest.values()))


def has_saved(folder: RunFolder) -> bool:
    """Whether its learner has said that it saved a checkpoint."""
    said = (record.get("checkpoint_update") for record in MetricsTail(folder.metrics, LISTED_BYTES).take())
    return any(is_finite(update) and update > 0 for update in said)


def starts(folder: RunFolder) -> list[Start]:
    """All that can be read, oldest first; an older version has kept none."""
    all_starts = []
    with suppress(FileNotFoundError):
        for line in folder.history_file.read_bytes().splitlines():
            with suppress(ValueError, TypeError, KeyError, RecursionError, ConfigError):
                start = from_dict(Start, DEFAULTS | json.loads(line), "")
                format_start(start)  # what cannot be shown is none
                all_starts.append(start)
    return all_starts


def begun_with(folder: RunFolder) -> dict[str, Any]:
    """The run whose networks it began with, as ``InitialCheckpoint`` tells it; empty where it began anew."""
    return next((start.init_from for start in starts(folder) if start.init_from is not None), {})


def format_begun(folder: RunFolder) -> str:
    """The options, as they were typed, with which the run began."""
    asked = begun_with(folder).get("asked")
    return "with --init-from {} --init-parts {}".format(*asked) if asked else "with nothing of another"


def resume_command(folder: RunFolder) -> str:
    """What to type in a shell to continue a run."""
    return f"rmc resume {shlex.quote(str(folder.path))}"


def last_launch(folder: RunFolder, launcher: Launcher | None = None) -> LaunchOptions:
    """How the run was started last; with another ``launcher`` only its device is taken. As by default if not known."""
    last = dataclasses.replace(LaunchOptions(folder.path), **_kept(folder))
    if launcher in (None, last.launcher):
        return last
    return LaunchOptions(folder.path, launcher=launcher, device=last.device)


def _kept(folder: RunFolder) -> dict[str, Any]:
    """What is kept of the last start; an option that was edited to a value of another kind is not."""
    kinds, kept = get_type_hints(LaunchOptions), {}
    for start in starts(folder)[-1:]:
        for name in start.launch.keys() & KEPT:
            with suppress(ConfigError):
                kept[name] = value_of_kind(kinds[name], start.launch[name], name)
    return kept


def format_starts(folder: RunFolder) -> str:
    """In a line; empty where nothing is known."""
    all_starts = starts(folder)
    words = [f"{len(all_starts)} starts" if len(all_starts) != 1 else "1 start"] if all_starts else []
    text = "; ".join([*words, *filter(None, map(format_start, all_starts))])
    return text if text.isprintable() else repr(text)  # a stranger's


def format_start(start: Start) -> str:
    """What it began with, and what changed; empty where nothing did."""
    words = []
    if start.init_from is not None:
        words.append("began with {parts} of {run}, update {checkpoint}".format(**start.init_from))
    changes = [f"{option(path)} {_word(was)} to {_word(now)}" for path, (was, now) in start.changes.items()]
    if changes:
        words.append(f"from step {start.env_steps:,} {', '.join(changes)}")
    return "; ".join(words)


def _word(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
