"""A real ``rmc sweep`` in a process of its own, of runs that are as short as can be."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self

import psutil

from tests.integration.running import ENVIRONMENT

PENDULUM = "InvertedPendulum-v5"
TINY = {"preset": "debug", "launcher": "lockstep", "total_steps": 700, "warmup_steps": 200, "checkpoint_steps": 200}
ENDLESS = {"total_steps": 10_000_000, "replay_ratio": 8.0}


def write_spec(folder: Path, tables: str = "", seeds: Sequence[int] = (0,), **options: Any) -> Path:
    """A SPEC.toml of tiny runs, with these options beside or in place of theirs."""
    lines = [f"{name} = {json.dumps(value)}" for name, value in {**TINY, **options}.items()]
    path = folder / "spec.toml"
    path.write_text("\n".join([f'env = "{PENDULUM}"', f"seeds = {list(seeds)}", "[options]", *lines, tables]))
    return path


class Sweeping:
    """Started at once; ``close`` kills what is left of it."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.folder, self.output = folder, folder.parent / f"{folder.name}-{time.monotonic_ns()}.out"
        command = [sys.executable, "-m", "rmc.cli.main", "sweep", *words, "--sweep-dir", str(folder)]
        with self.output.open("wb") as output:
            self.process = subprocess.Popen(
                command, stdout=output, stderr=output, stdin=subprocess.DEVNULL, env=ENVIRONMENT, process_group=0
            )

    def text(self) -> str:
        """All that it printed."""
        return self.output.read_text(errors="replace")

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
        for child in psutil.Process(self.process.pid).children(recursive=True):
            try:
                words = child.cmdline()
            except psutil.Error:
                continue
            if "train" in words and str(self.folder / name) in words:
                return child
        return None

    def wait_for(self, condition: Callable[[], Any], seconds: float = 120.0) -> None:
        """Wait until the condition holds, while the sweep goes on."""
        deadline = time.monotonic() + seconds
        while not condition():
            assert self.process.poll() is None, f"the sweep has ended:\n{self.text()}"
            assert time.monotonic() < deadline, f"waited {seconds} s in vain:\n{self.text()}"
            time.sleep(0.1)

    def wait_for_updates(self, *names: str) -> None:
        """Wait until these runs train."""
        self.wait_for(lambda: all(self._has_updates(self.folder / name) for name in names))

    def _has_updates(self, run: Path) -> bool:
        metrics = run / "metrics.jsonl"
        lines = metrics.read_text().splitlines(keepends=True) if metrics.exists() else []
        records = [json.loads(line) for line in lines if line.endswith("}\n")]
        return any(record["role"] == "learner" and record.get("updates", 0) > 0 for record in records)

    def finish(self, seconds: float = 150.0) -> int:
        """Wait for the end; the exit status."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"not finished after {seconds} s:\n{self.text()}") from None

    def interrupt(self) -> int:
        """Ctrl-C; the exit status."""
        self.process.send_signal(signal.SIGINT)
        return self.finish(60.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
