"""Keeps a run's roles alive as processes of this machine, and ends them so that nothing is left behind."""

import errno
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from rmc.common.errors import CONFIG_STATUS, RoleDied
from rmc.common.process.role import TERMINATED_STATUS
from rmc.common.process.watchdog import HUNG_STATUS, HUNG_WORDS, SLACK
from rmc.deploy.local.fork_server import ForkedProcess, ForkServer, open_log
from rmc.deploy.local.role_command import RoleCommand
from rmc.deploy.local.role_environment import SINGLE_THREAD, command_line, start_process

# So many deaths of a role's own in a row, each within so long of its start, end the run.
QUICK_DEATHS, QUICK_SECONDS = 3, 60.0
FIRST_BACKOFF, LONGEST_BACKOFF = 0.25, 10.0  # seconds before a role is started again, doubled at each quick death
STOP_SECONDS = 3.5  # for the roles to end cleanly; then they are killed
HELD_SECONDS = 20.0  # that a learner may be held by a replay server or Redis that hangs, before it hears and saves
TRACEBACK_BYTES = 8192
NO_PROCESS = errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE  # for now
log = logging.getLogger(__name__)


def from_outside(status: int) -> bool:
    """Whether somebody else ended it, for whom it can do nothing: it is started again, however often."""
    return status in (-signal.SIGKILL, -signal.SIGTERM, TERMINATED_STATUS)


class QuickDeaths:
    """A role's own deaths in a row, each soon after its start; too many of them end the run."""

    def __init__(self, name: str, env_timeout: float) -> None:
        self.name, self.env_timeout, self.count = name, env_timeout, 0

    def note(self, status: int, lived: float, last_words: str, where: str = "") -> None:
        """One more, after so many seconds. Raises RoleDied where it is one too many, or starting again cannot help."""
        hung = status == HUNG_STATUS or (status == 1 and last_words.startswith(HUNG_WORDS))
        lived -= SLACK * self.env_timeout if hung else 0.0
        self.count = self.count + 1 if lived < QUICK_SECONDS and not from_outside(status) else 0
        if self.count >= QUICK_DEATHS or status == CONFIG_STATUS:
            how = f"killed by signal {-status}" if status < 0 else f"exit status {status}"
            often = f"{self.count} times in a row soon after its start" if self.count > 1 else "at once"
            raise RoleDied(f"{self.name} ended {often}{where}, {how}; its last words:\n{last_words}")


class RoleProcess:
    """One role: its process, its log, its deaths. Of a single thread, it is forked where there is a fork server."""

    def __init__(
        self, command: RoleCommand, environment: dict[str, str], logs: Path, fork_server: ForkServer | None = None
    ) -> None:
        self.command, self.log, self.restarts = command, logs / f"{command.name}.log", 0
        self._environment = {**environment, **(SINGLE_THREAD if command.single_thread else {})}
        self._fork_server = fork_server if command.single_thread and command.forked else None
        self._process: subprocess.Popen[bytes] | ForkedProcess | None = None
        self.log_start = 0  # where in its log this start's words begin
        self._started_at, self._start_at = 0.0, 0.0
        self._deaths, self.finished = QuickDeaths(command.name, command.env_timeout), False

    @property
    def running(self) -> bool:
        """Whether its process is there."""
        return self._process is not None and self._process.poll() is None

    @property
    def pid(self) -> int | None:
        """Its process, if it runs."""
        return self._process.pid if self._process is not None and self.running else None

    @property
    def status(self) -> int | None:
        """Its exit status, negative for a signal; None while it runs."""
        return self._process.poll() if self._process is not None else None

    def start(self) -> None:
        """Start its process. Raises as ``ForkServer.fork`` does."""
        self.log_start = self.log.stat().st_size if self.log.exists() else 0
        self._started_at = time.monotonic()
        with open_log(self.log) as log:
            if self._fork_server is not None:
                self._process = self._fork_server.fork(self.command.words, self._environment, log.fileno())
            else:
                self._process = start_process(command_line(self.command.words), log, self._environment)

    def tend(self) -> None:
        """Note a death, or start again when it is time. Raises RoleDied."""
        if self.finished or self.running:
            return
        if (status := self.status) is not None:
            self._end_group()
            self._process = None
            if status == 0 and self.command.ends:
                self.finished = True
            else:
                self._note_death(status)
        elif time.monotonic() >= self._start_at:
            self.restarts += self.start_or_wait()

    def start_or_wait(self) -> bool:
        """Start it, or later, where this machine has no process or no memory to give now; whether it is started."""
        try:
            self.start()
        except OSError as error:
            if error.errno not in NO_PROCESS:
                raise
            log.warning("%s cannot be started now (%s); trying again", self.command.name, error.strerror)
            self._start_at = time.monotonic() + LONGEST_BACKOFF
            return False
        return True

    def _note_death(self, status: int) -> None:
        now = time.monotonic()
        self._deaths.note(status, now - self._started_at, self.last_words())
        self._start_at = now + min(FIRST_BACKOFF * 2**self._deaths.count, LONGEST_BACKOFF)

    def last_words(self) -> str:
        """The end of its log, of this start only: the traceback, if it left one."""
        text = ""
        with suppress(OSError), self.log.open("rb") as log:
            log.seek(max(self.log_start, self.log.stat().st_size - TRACEBACK_BYTES))
            text = log.read().decode(errors="replace").rstrip()
        start = max(text.rfind("Traceback (most recent call last)"), text.rfind(HUNG_WORDS))
        return text[start:] if start >= 0 else "\n".join(text.splitlines()[-20:]) or "(none)"

    def signal(self, number: int) -> None:
        """Send a signal to its process group, if it runs."""
        if self.running:
            assert self._process is not None
            with suppress(ProcessLookupError):  # it has ended since
                os.killpg(self._process.pid, number)

    def reap(self, timeout: float) -> bool:
        """Wait for its end; whether it came."""
        if self._process is None:
            return True
        try:
            self._process.wait(max(0.0, timeout))
        except subprocess.TimeoutExpired:
            return False
        self._end_group()
        return True

    def _end_group(self) -> None:
        """What it has started goes with it; the fork server, which sees to those that left the group, may be gone."""
        if self._process is not None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)


class Supervisor:
    """All roles of a run. ``tend`` them often; ``stop`` them at the end, whatever the end was."""

    def __init__(
        self,
        commands: list[RoleCommand],
        environment: Callable[[str], dict[str, str]],
        logs: Path,
        patience: Callable[[str], float],
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """``environment`` is of each role by its name, beside this process's own.

        ``patience``, asked at the end, is how many seconds a role may need to end cleanly, if more than is usual.
        ``stopped`` says whether to wait no longer for a role's start, which then raises KeyboardInterrupt.
        """
        self._patience = patience
        self._fork_server = (
            ForkServer(logs / "fork_server.log", stopped) if sys.platform == "linux" else None
        )  # elsewhere a fork may crash
        self.roles = {
            command.name: RoleProcess(command, environment(command.name), logs, self._fork_server)
            for command in commands
        }

    def start(self) -> None:
        """Start every role: first those that need no fork server, which takes its time to begin."""
        for role in sorted(self.roles.values(), key=lambda role: role.command.single_thread):
            role.start_or_wait()

    def tend(self) -> None:
        """Start dead roles again. Raises RoleDied for one that dies too often."""
        for role in self.roles.values():
            role.tend()

    def restarts(self) -> dict[str, int]:
        """How often each role was started again."""
        return {name: role.restarts for name, role in self.roles.items()}

    def stop(self) -> None:
        """End every role, the replay servers after the others, which may need them; kill what does not end in time."""
        deadline = time.monotonic() + STOP_SECONDS
        last = [role for name, role in self.roles.items() if name.startswith("replay")]
        others = [role for role in self.roles.values() if role not in last]
        try:
            self._end(others, STOP_SECONDS * 3 / 4)
            self._end(last, max(deadline - time.monotonic(), STOP_SECONDS / 4))
        finally:
            for role in self.roles.values():
                role.signal(signal.SIGKILL)
                role.reap(STOP_SECONDS)
            if self._fork_server is not None:
                self._fork_server.close()

    def _end(self, roles: list[RoleProcess], seconds: float) -> None:
        began = time.monotonic()
        for role in roles:
            role.signal(signal.SIGTERM)
        for role in roles:
            role.reap(began + max(seconds, self._patience(role.command.name)) - time.monotonic())
