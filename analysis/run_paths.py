"""What a command that takes many runs is given: folders of runs, folders that hold such, patterns, files of lines."""

import glob
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from rmc.common.errors import ConfigError

log = logging.getLogger(__name__)
T = TypeVar("T")


def expanded(path: Path) -> list[Path]:
    """The runs and files that a path means, by name: itself, what a pattern matches, all runs in a folder.

    Raises ConfigError where a folder or a pattern has none.
    """
    if path.is_dir():
        folders = sorted(run_folders(path))
        if not folders and not (path / "config.json").exists():  # all that a run has at first
            raise ConfigError("RUNS", str(path), "no run in there; give runs, or a folder that holds some")
        return folders or [path]
    if path.exists() or not glob.has_magic(str(path)):
        return [path]
    matched = sorted(map(Path, glob.glob(str(path), recursive=True)))
    if not matched:
        raise ConfigError("RUNS", str(path), "matches nothing; give runs, or a folder that holds some")
    runs = [run for one in matched if one.is_dir() for run in run_folders(one)]
    return runs or [one for one in matched if one.is_file()]  # what lies beside runs is not meant


def run_folders(folder: Path) -> Iterator[Path]:
    """Those of rmc train, rmc baseline and sweeps, however deep; nothing below a run is looked at.

    Links are followed, each folder once.
    """
    seen: set[str] = set()
    for path, below, files in os.walk(
        folder, onerror=lambda error: log.warning("%s (left out)", error), followlinks=True
    ):
        where = os.path.realpath(path)
        is_run, is_new = _is_run(below, files), where not in seen
        seen.add(where)
        if is_run or not is_new:
            below.clear()
        if is_run and is_new:
            yield Path(path)


def _is_run(folders: list[str], files: list[str]) -> bool:
    """By what is in a folder: also a copy without checkpoints, or one whose config.json is lost."""
    trained = not {"metrics.jsonl", "result.json"}.isdisjoint(files)
    begun = not {"config.json", "metrics.jsonl", ".lock"}.isdisjoint(files)
    return ("config.json" in files and trained) or ("checkpoints" in folders and begun)


def each_readable(
    given: Sequence[Path], read: Callable[[Path], T], otherwise: str = "none of them is a run's folder"
) -> list[T]:
    """What can be read of all that is meant, each once; the others are told.

    Raises ConfigError where nothing is given or can be read: that one's own where there is one alone, or ``otherwise``.
    """
    if not given:
        raise ConfigError("RUNS", "", "give folders of runs")
    found, once = [], {os.path.realpath(path): path for one in given for path in expanded(one)}
    for path in once.values():
        try:
            found.append(read(path))
        except (ConfigError, OSError) as error:
            if len(once) == 1:
                raise
            log.warning("%s (left out)", error)
    if not found:
        raise ConfigError("RUNS", " ".join(map(str, given)), otherwise)
    return found
