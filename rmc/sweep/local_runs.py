"""Whole runs as processes of this machine, each on its own part of the cores."""

import os
import signal
import subprocess
from pathlib import Path

from rmc.deploy.local.role_environment import command_line, start_process
from rmc.deploy.run.host import cores
from rmc.sweep.job import Job


class LocalRuns:
    """So many at once; more than cores share them."""

    def __init__(self, at_once: int) -> None:
        self._free = core_parts(at_once)

    def has_room(self) -> bool:
        return bool(self._free)

    def start(self, job: Job) -> "RunProcess":
        return RunProcess(job, self._free.pop(0), self._free)


class RunProcess:
    """A process that ends with this one."""

    def __init__(self, job: Job, part: set[int], free: list[set[int]]) -> None:
        self._log, self._part, self._free = job.log, part, free
        self._process = spawn(job.command(job.folder), job.log)
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(self._process.pid, part)

    def status(self) -> int | None:
        status = self._process.poll()
        if status is not None:
            self._free.append(self._part)
        return status

    def stop(self) -> None:
        self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it now; its roles end with it."""
        self._process.kill()
        self._process.wait()

    def last_words(self) -> str:
        return last_log_line(self._log)


def core_parts(count: int) -> list[set[int]]:
    """The cores in as many parts; more parts than cores share them."""
    numbers = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(cores()))
    return [set(numbers[index::count]) or {numbers[index % len(numbers)]} for index in range(count)]


def spawn(words: list[str], log: Path) -> "subprocess.Popen[bytes]":
    """``rmc`` as a process that ends with this one, and that a terminal's Ctrl-C does not reach."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as output:
        return start_process(command_line(words), output, {})


def last_log_line(log: Path) -> str:
    """Of what a run said."""
    lines = log.read_text(errors="replace").strip().splitlines() if log.exists() else []
    return lines[-1] if lines else "no word"
