"""What a command that takes many runs is given: folders of runs, folders that hold such, patterns, files of lines."""

import glob
import os
from collections.abc import Iterator
from pathlib import Path

from rmc.common.errors import ConfigError


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
    for path, below, files in os.walk(folder):
        if "checkpoints" in below and not {"config.json", "metrics.jsonl", ".lock"}.isdisjoint(files):
            below.clear()
            yield Path(path)
