"""Runs side by side: starts what there is room for, ends cleanly, and tells how each ended."""

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import STOPPED_STATUS, ConfigError
from rmc.common.process.role import StopSignal
from rmc.deploy.monitor.attach import STOP_SECONDS
from rmc.deploy.run.folder import RunFolder
from rmc.sweep.job import Job

LOOK_SECONDS = 0.2
State = Literal["waiting", "running", "finished", "pruned", "stopped", "failed"]
OVER = ("finished", "pruned")  # which are not run again


@dataclass(frozen=True)
class Ending:
    """How a run ended."""

    state: State
    seconds: float
    reason: str = ""


class Run(Protocol):
    """A run that was started."""

    def status(self) -> int | None:
        """Its exit status, once it has one and all that it left is in the job's folder; negative after a signal."""

    def stop(self) -> None:
        """Ask it to end cleanly; does not wait."""

    def kill(self) -> None:
        """End it now."""

    def last_words(self) -> str:
        """What it said last."""


class Place(Protocol):
    """Where runs run."""

    def has_room(self) -> bool:
        """Whether another one fits now."""

    def start(self, job: Job) -> Run:
        """Start one; it continues from what its folder has. Raises ConfigError where somebody else trains it."""


class SweepPlan(Protocol):
    """Which runs there are."""

    def next(self) -> Job | None:
        """The next one to start; None where there is none, now or any more."""

    def is_hopeless(self, job: Job) -> bool:
        """Whether a run at work may as well be stopped."""

    def end(self, job: Job, ending: Ending) -> None:
        """Hears how one ended."""


@dataclass
class _AtWork:
    job: Job
    run: Run
    began: float
    deadline: float | None = None  # once it was asked to end
    hopeless: bool = False

    def stop(self) -> None:
        if self.deadline is None:
            seconds = STOP_SECONDS + CheckpointFolder(RunFolder(self.job.folder).checkpoints).patience(0.0)
            self.deadline = time.monotonic() + seconds
            self.run.stop()
        elif time.monotonic() > self.deadline:
            self.run.kill()

    def ending(self, status: int) -> Ending:
        seconds = time.monotonic() - self.began
        if status == 0:
            return Ending("finished", seconds)
        if self.hopeless and self.deadline is not None:  # killed, too: it may have been asked before it could hear it
            return Ending("pruned", seconds)
        if status == STOPPED_STATUS or self.deadline is not None:
            return Ending("stopped", seconds)
        how = f"killed by signal {-status}" if status < 0 else f"ended with {status}: {self.run.last_words()}"
        return Ending("failed", seconds, f"{how}; see {self.job.log}")


def conduct(
    plan: SweepPlan, place: Place, stop: StopSignal, begun: Callable[[Job], None], ended: Callable[[Job, Ending], None]
) -> None:
    """Run all of a plan; with a stop signal no other one starts, and those at work end cleanly."""
    at_work: list[_AtWork] = []

    def over(job: Job, ending: Ending) -> None:
        plan.end(job, ending)
        ended(job, ending)

    try:
        while True:
            while not stop.requested and place.has_room() and (job := plan.next()) is not None:
                begun(job)
                try:
                    at_work.append(_AtWork(job, place.start(job), time.monotonic()))
                except ConfigError as error:
                    over(job, Ending("failed", 0.0, str(error)))
            if not at_work:
                return
            for one in list(at_work):
                one.hopeless = one.hopeless or plan.is_hopeless(one.job)
                if stop.requested or one.hopeless:
                    one.stop()
                status = one.run.status()
                if status is not None:
                    at_work.remove(one)
                    over(one.job, one.ending(status))
            time.sleep(LOOK_SECONDS)
    finally:
        _end(at_work)  # only where an error ends the sweep itself


def _end(at_work: list[_AtWork]) -> None:
    """Cleanly, where that comes in time."""
    try:
        while at_work := [one for one in at_work if one.run.status() is None]:
            for one in at_work:
                one.stop()
            time.sleep(LOOK_SECONDS)
    finally:  # of a cluster that is gone
        for one in at_work:
            one.run.kill()


def drop_replay(job: Job) -> None:
    """Remove a finished run's rings. Its checkpoints, metrics and result stay; trained longer, it fills another."""
    if RunFolder(job.folder).lock.trainer() is not None:  # by hand, longer than the sweep did
        return
    for ring in RunFolder(job.folder).rings():
        shutil.rmtree(ring, ignore_errors=True)
