"""Keeps a run's roles alive as processes of this machine, and ends them so that nothing is left behind."""

import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from rmc.deploy.local.fork_server import ForkServer
from rmc.deploy.local.role_command import RoleCommand
from rmc.deploy.local.role_process import RoleProcess

STOP_SECONDS = 3.5  # for the roles to end cleanly; then they are killed
HELD_SECONDS = 20.0  # that a learner may be held by a replay server or Redis that hangs, before it hears and saves


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
