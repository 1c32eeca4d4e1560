"""What a command that takes many runs is given: folders of runs, folders that hold such, patterns, files of lines."""

import glob
import logging
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from rmc.common.errors import ConfigError

log = logging.getLogger(__name__)
T = TypeVar("T")


def expanded(path: Path) -> list[Path]:
    """The runs and files that a path means, by name: itself, what a pattern matches, all runs in a folder.

    Raises ConfigError where a folder or a pattern has none.
    """
    if (path / "config.json").exists():
        return [path]
    if path.is_dir():
        folders = sorted(run_folders(path))
        if not folders:
            raise ConfigError("RUNS", str(path), "no run in there; give runs, or a folder that holds some")
        return folders
    if path.exists() or not glob.has_magic(str(path)):
        return [path]
    matched = sorted(map(Path, glob.glob(str(path), recursive=True)))
    if not matched:
        raise ConfigError("RUNS", str(path), "matches nothing; give runs, or a folder that holds some")
    runs = [run for one in matched if one.is_dir() for run in run_folders(one)]
    return runs or [one for one in matched if one.is_file()]  # what lies beside runs is not meant


def run_folders(folder: Path) -> Iterator[Path]:
    """Those of rmc train, rmc baseline and sweeps, however deep; nothing below a run is looked at."""
    for path, below, files in os.walk(folder, onerror=lambda error: log.warning("%s (left out)", error)):
        if "checkpoints" in below and not {"config.json", "metrics.jsonl", ".lock"}.isdisjoint(files):
            below.clear()
            yield Path(path)


def each_readable(paths: Iterable[Path], read: Callable[[Path], T]) -> list[T]:
    """What can be read, each path once; the others are told. Raises ConfigError where there is one alone."""
    found, once = [], list(dict.fromkeys(paths))
    for path in once:
        try:
            found.append(read(path))
        except ConfigError as error:
            if len(once) == 1:
                raise
            log.warning("%s (left out)", error)
    return found
