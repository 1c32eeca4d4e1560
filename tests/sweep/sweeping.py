"""A real ``rmc sweep`` in a process of its own, of runs that are as short as can be."""

import json
import re
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil

from tests.integration.running import Command, records_of
from tests.processes import matching

PENDULUM = "InvertedPendulum-v5"
TINY = {"preset": "debug", "launcher": "lockstep", "total_steps": 700, "warmup_steps": 200, "checkpoint_steps": 200}
ENDLESS = {"total_steps": 10_000_000, "replay_ratio": 8.0}


def write_spec(folder: Path, tables: str = "", seeds: Sequence[int] = (0,), **options: Any) -> Path:
    """A SPEC.toml of tiny runs, with these options beside or in place of theirs; without those that are None."""
    lines = [f"{name} = {json.dumps(value)}" for name, value in {**TINY, **options}.items() if value is not None]
    path = folder / "spec.toml"
    path.write_text("\n".join([f'env = "{PENDULUM}"', f"seeds = {list(seeds)}", "[options]", *lines, tables]))
    return path


class Sweeping(Command):
    """A sweep."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.folder = folder
        output = folder.parent / f"{folder.name}-{time.monotonic_ns()}.out"
        super().__init__(output, ["sweep", *words, "--sweep-dir", str(folder)], {})

    def lines(self) -> dict[str, dict[str, Any]]:
        """Of its index, by run."""
        path = self.folder / "sweep.jsonl"
        lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
        return {line["run"]: line for line in lines}

    def states(self) -> dict[str, str]:
        """Of its runs."""
        return {name: line["state"] for name, line in self.lines().items()}

    def run_process(self, name: str) -> psutil.Process | None:
        """The process of one of its runs."""
        children = psutil.Process(self.process.pid).children(recursive=True)
        return next(matching(rf" train .*{re.escape(str(self.folder / name))}( |$)", children), None)

    def wait_for_updates(self, *names: str) -> None:
        """Wait until these runs train."""
        self.wait_for(lambda: all(map(self._has_updates, names)))

    def _has_updates(self, name: str) -> bool:
        return any(record.get("updates", 0) > 0 for record in records_of(self.folder / name, "learner"))

    def interrupt(self) -> int:
        """Ctrl-C; the exit status."""
        self.process.send_signal(signal.SIGINT)
        return self.finish(60.0)
