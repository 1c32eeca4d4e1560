"""A real ``rmc`` in a process of its own, and what can be seen of a run from outside."""

import json
import os
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import psutil

from tests.command import COMMAND
from tests.processes import matching
from tests.waiting import wait_until

START_SECONDS = 120.0  # five processes import torch on two cores that other tests may use
SMALL = (
    "--hidden", "64", "--embedding", "64", "--heads", "128", "128", "--head-input", "hidden+observation",
    "--normalize-observations",
)  # fmt: skip
FAST = ("--learning-rate", "5e-4", "--polyak", "0.99", "--target-memory", "ema", "--batch-size", "16")
DATA = ("--capacity", "5000", "--warmup-steps", "1000", "--priority-exponent", "0", "--episodes", "10")
ENVIRONMENT = {**os.environ, "RMC_SECRET": "", "COLUMNS": "200"}


def free_port() -> int:
    """Of this machine's own address."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def records_of(run: Path, role: str) -> list[dict[str, Any]]:
    """What a role of a run has said so far."""
    path = run / "metrics.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    records = [json.loads(line) for line in lines if line.endswith("}\n")]
    return [record for record in records if record["role"] == role]


def newest_in(records: list[dict[str, Any]], name: str, default: Any) -> Any:
    """The newest value of a metric; the default where nobody has said it."""
    return next((record[name] for record in reversed(records) if name in record), default)


class Command:
    """``rmc``, started at once; ``close`` kills what is left of it."""

    def __init__(self, output: Path, words: Sequence[str], environment: Mapping[str, str]) -> None:
        """What it prints goes to the end of the file ``output``."""
        self.output = output
        with output.open("ab") as file:
            self.process = subprocess.Popen(
                [*COMMAND, *words], stdout=file, stderr=file, stdin=subprocess.DEVNULL,
                env={**ENVIRONMENT, **environment}, process_group=0,
            )  # fmt: skip

    def text(self) -> str:
        """All that it printed."""
        return self.output.read_text(errors="replace")

    def logs(self) -> str:
        """What else may tell why something has failed."""
        return ""

    def wait_for(self, condition: Callable[[], Any], seconds: float = START_SECONDS) -> None:
        """Wait until the condition holds, while it goes on."""

        def holds() -> Any:
            result = condition()
            assert result or self.process.poll() is None, f"it has ended:\n{self.text()}"
            return result

        wait_until(holds, seconds, lambda: f"waited {seconds} s in vain:\n{self.text()}\n{self.logs()}", 0.1)

    def finish(self, seconds: float = 150.0) -> int:
        """Wait for the end; the exit status."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"not finished after {seconds} s:\n{self.text()}\n{self.logs()}") from None

    def close(self) -> None:
        """Kill what is left."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class Training(Command):
    """A run."""

    def __init__(
        self,
        folder: Path,
        *options: str,
        env: str = "InvertedPendulum-v5",
        preset: str = "debug",
        environment: Mapping[str, str] = MappingProxyType({}),
        command: tuple[str, ...] = (),
    ) -> None:
        """``command`` goes in the place of ``train`` and all of its options."""
        self.folder = folder
        train = ("train", env, "--preset", preset, "--run-dir", str(folder), *options)
        super().__init__(folder.parent / f"{folder.name}.out", command or train, environment)
        self.launcher = psutil.Process(self.process.pid)

    def sockets(self) -> list[Path]:
        """The files of its temporary folder."""
        folders = Path(tempfile.gettempdir()).glob(f"rmc-sockets-{self.process.pid}-*")
        return [path for folder in folders for path in (folder, *folder.iterdir())]

    def records(self, role: str) -> list[dict[str, Any]]:
        """The role's metrics so far."""
        return records_of(self.folder, role)

    def newest(self, role: str, name: str, default: Any = 0) -> Any:
        """The newest value of a metric."""
        return newest_in(self.records(role), name, default)

    def role(self, name: str) -> psutil.Process | None:
        """A role's process; the role's name is ``actor``, ``replay``, ``learner``, ``evaluator`` or ``redis``."""
        pattern = "unixsocket" if name == "redis" else rf"rmc\.cli\.main role {name} "
        return next(matching(pattern, self.launcher.children(recursive=True)), None)

    def wait_for_updates(self, more: int = 1) -> None:
        """Wait until the learner has made so many more updates."""
        goal = self.newest("learner", "updates") + more
        self.wait_for(lambda: self.newest("learner", "updates") >= goal)

    def logs(self) -> str:
        """The ends of the roles' logs."""
        logs = sorted((self.folder / "logs").glob("*.log"))
        return "\n".join(f"== {path.name}\n{path.read_text(errors='replace')[-2000:]}" for path in logs)

    def interrupt(self) -> float:
        """Ctrl-C; how long everything took to end."""
        began = time.monotonic()
        self.process.send_signal(signal.SIGINT)
        self.process.wait(30)
        return time.monotonic() - began
