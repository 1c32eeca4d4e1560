"""Every start of a run, a line each in its folder's ``history.jsonl``: when, by which version, what changed."""

import dataclasses
import json
import os
import shlex
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any

from rmc.common.bus.redis_url import has_password
from rmc.deploy.run.config import option
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions

KEPT = ("launcher", "device", "redis_url", "ray_address", "all_cpus", "tls")  # of how a run was started last


@dataclass(frozen=True)
class Start:
    """One of a run's starts."""

    time: float
    version: str
    env_steps: int  # that the run had then
    changes: dict[str, list[Any]] = field(default_factory=dict)  # what it was and is, by the option's path
    launch: dict[str, Any] = field(default_factory=dict)
    init_from: dict[str, Any] | None = None  # at the first start: run, checkpoint and parts


def note_start(
    folder: RunFolder, changes: dict[str, list[Any]], options: LaunchOptions, init_from: dict[str, Any] | None
) -> None:
    """Add a line that is on the disk before the run goes on. Raises OSError."""
    launch = {name: getattr(options, name) for name in KEPT}
    if options.redis_url is not None and has_password(options.redis_url):
        launch["redis_url"] = None  # it must be said again
    start = Start(time.time(), version("rmc-rl"), folder.env_steps(), changes, launch, init_from)
    path = folder.history_file
    torn = path.exists() and not path.read_bytes().endswith(b"\n")  # by a crash
    with path.open("a") as file:
        file.write("\n" * torn + json.dumps(asdict(start)) + "\n")
        file.flush()
        os.fsync(file.fileno())


def starts(folder: RunFolder) -> list[Start]:
    """All that can be read, oldest first; an older version has kept none."""
    found = []
    with suppress(FileNotFoundError):
        for line in folder.history_file.read_bytes().splitlines():
            with suppress(ValueError, TypeError):
                found.append(Start(**json.loads(line)))
    return found


def resume_command(folder: RunFolder) -> str:
    """What to type in a shell to go on with a run."""
    return f"rmc resume {shlex.quote(str(folder.path))}"


def last_launch(folder: RunFolder) -> LaunchOptions:
    """How the run was started last; as by default where that is not known."""
    known = starts(folder)
    kept = {name: value for name, value in known[-1].launch.items() if name in KEPT} if known else {}
    return dataclasses.replace(LaunchOptions(folder.path), **kept)


def format_starts(folder: RunFolder) -> str:
    """In a line; empty where nothing is known."""
    known = starts(folder)
    words = [f"{len(known)} starts" if len(known) != 1 else "1 start"] if known else []
    for start in known:
        if start.init_from is not None:
            words.append("began with {parts} of {run}, update {checkpoint}".format(**start.init_from))
        told = [f"{option(path)} {_word(was)} to {_word(now)}" for path, (was, now) in start.changes.items()]
        if told:
            words.append(f"from step {start.env_steps:,} {', '.join(told)}")
    return "; ".join(words)


def _word(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
