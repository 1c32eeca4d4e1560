"""A role's host on a Ray cluster, as its launcher sees it."""

import dataclasses
import logging
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import ray

from rmc.deploy.local.fork_server import open_log
from rmc.deploy.local.role_process import QuickDeaths
from rmc.deploy.ray.role_actor import RoleReport

POLL_SECONDS = 0.5  # between questions to each host
log = logging.getLogger(__name__)


class RoleHandle:
    """A role's host as the launcher sees it: asked how it is again and again, without waiting for it."""

    def __init__(self, name: str, handle: Any, env_timeout: float = 0.0) -> None:
        self.name, self.handle = name, handle
        self.report: RoleReport | None = None  # the newest; None until the first
        self.restarts = 0
        self.dead = ""  # for good, and why: somebody killed it, or it could not begin
        self.waits_since = time.monotonic()  # for a CPU, or to be started again; unless it runs
        self._question: Any = None
        self._asked_at = self._began_at = 0.0
        self._deaths, self._death_noted = QuickDeaths(name, env_timeout), ""

    @property
    def running(self) -> bool:
        """Whether its role was running when last heard of."""
        return self.report is not None and self.report.pid is not None

    @property
    def awaited(self) -> bool:
        """Whether its role runs, or what it left is not yet put away."""
        return self.report is not None and self.report.status is None

    @property
    def node(self) -> str:
        """Where its role was last heard of."""
        return self.report.node if self.report is not None else ""

    @property
    def trouble(self) -> str:
        """What kept it, when last heard of, from bringing to the head what belongs there."""
        return self.report.trouble if self.report is not None else ""

    def ask(self, logs: Path) -> None:
        """Take in an answer that has come, and ask again. Raises RoleDied."""
        if self._question is None:
            if time.monotonic() >= self._asked_at + POLL_SECONDS:
                self._asked_at = time.monotonic()
                incarnation, end = (self.report.incarnation, self.report.log_end) if self.report else ("", 0)
                self._question = self.handle.report.remote(incarnation, end)
            return
        if not ray.wait([self._question], timeout=0)[0]:
            return
        question, self._question = self._question, None
        try:
            self._hear(ray.get(question), logs)
        except ray.exceptions.ActorDiedError as error:
            self.dead = str(error)
        except ray.exceptions.RayError:  # being started again
            self.waits_since = time.monotonic() if self.running else self.waits_since
            self.report = dataclasses.replace(self.report, pid=None) if self.report else None

    def _hear(self, report: RoleReport, logs: Path) -> None:
        if self.report is None or report.incarnation != self.report.incarnation:
            self.restarts += self._began_at > 0
            self._began_at = time.monotonic()
        if self.running and report.pid is None:
            self.waits_since = time.monotonic()
        if report.trouble != self.trouble:
            log.warning("%s: %s", self.name, report.trouble or "checkpoints reach the head again")
        self.report = report
        if report.log or not (logs / f"{self.name}.log").exists():
            with suppress(OSError), open_log(logs / f"{self.name}.log") as file:
                file.write(report.log)  # lost where the disk is full
        if report.status and self._death_noted != report.incarnation:
            self._death_noted = report.incarnation
            self._note_death(report)

    def _note_death(self, report: RoleReport) -> None:
        assert report.status is not None
        lived = time.monotonic() - self._began_at
        self._deaths.note(report.status, lived, report.last_words, f" on {report.node}")
