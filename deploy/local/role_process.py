"""One role as a process of this machine: its start, its log, its deaths."""

import errno
import logging
import os
import signal
import subprocess
import time
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
