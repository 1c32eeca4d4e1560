"""Every role in one thread over the in-process bus: same seed, same bits. For debugging and tests."""

import itertools
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from rmc.actors.actor import Actor
from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.protocol import Bus
from rmc.common.env.make import make_env
from rmc.common.env.wrappers import Env
from rmc.common.metrics import BusyClock
from rmc.common.process.role import METRICS_PERIOD, Role, StopSignal
from rmc.common.shard import WHOLE
from rmc.deploy.local.actor_process import make_actor, make_evaluator
from rmc.deploy.local.learner_process import make_learner
from rmc.deploy.local.replay_process import make_server
from rmc.deploy.redis.progress_backup import ProgressBackup
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder


class Lockstep:
    """A whole run, stepped in a fixed order: the learner while the limiter lets it, else the actors.

    Checkpoints drop unfinished episodes and reseed the environments, whether or not the run stops
    there: only so can stop-and-resume give the same bits for any environment.
    """

    def __init__(self, config: RunConfig, folder: Path, device: str = "cpu") -> None:
        self.bus, self._progress_backup = MemoryBus(), ProgressBackup(RunFolder(folder), 1)
        self._progress_backup.restore(self.bus)
        with ExitStack() as opened:  # else a notebook would keep the locks of a start that failed
            self.server = make_server(config, folder / "replay", self.bus, WHOLE)
            opened.callback(self.server.close)
            self.server.step()  # publishes what a resumed ring has seen, from which actors take their epochs
            self.learner = make_learner(config, self.server, self.bus, folder / "checkpoints", device, (), False)
            opened.callback(self.learner.checkpoints.unlock)
            self._make_players(config, opened)
            opened.pop_all()
        self._last_checkpoint = self.learner.last_checkpoint
        self._restart_due = self._playing = False

    def _make_players(self, config: RunConfig, opened: ExitStack) -> None:
        """Actors and evaluator; what they hold is closed with ``opened``."""
        ticks = itertools.count()

        def clock() -> float:
            """Timers count calls, so that no clock decides anything."""
            return float(next(ticks))

        def env() -> Env:
            return make_env(config.env, privileged=config.agent.privileged_critic)

        self.actors: list[Actor] = []
        for index in range(config.actors):
            self.actors.append(make_actor(config, index, env, self.bus, clock))
            opened.callback(self.actors[-1].close)
        uncut = replace(config, evaluator=replace(config.evaluator, evaluation_seconds=0.0))
        plays = config.evaluator.episodes > 0
        self.evaluator = make_evaluator(uncut, lambda: make_env(config.env), self.bus, clock) if plays else None

    @property
    def roles(self) -> list[Role]:
        return [self.learner, self.server, *self.actors, *([self.evaluator] if self.evaluator else [])]

    @property
    def finished(self) -> bool:
        """Whether all is trained, and the last checkpoint evaluated."""
        return self.learner.finished and not self._playing

    def step(self) -> None:
        """One update, or one round of collection where none is due; after a checkpoint one step of its evaluation."""
        if self._playing and self.evaluator is not None:
            self._playing = self.evaluator.step()
            return
        if self._restart_due:
            self._restart_due = False
            for actor in self.actors:
                actor.restart()
        if not self.learner.step():
            for actor in self.actors:
                actor.step()
            while self.server.step():
                pass
        if self.learner.last_checkpoint != self._last_checkpoint:
            self._after_checkpoint()

    def _after_checkpoint(self) -> None:
        """Save the ring beside the learner; the actors begin anew in the next step, as those of a resumed run do."""
        self._last_checkpoint = self.learner.last_checkpoint
        self.server.checkpoint()
        self._progress_backup.keep(self.bus, at_once=True)
        self._restart_due, self._playing = True, self.evaluator is not None

    def emit_metrics(self, clock: BusyClock) -> None:
        """Of every role; all have one thread, whose shares the learner's record has. The others' are 0."""
        for role in self.roles:
            self.bus.emit(role.name, {**role.metrics(), **clock.shares()})

    def close(self) -> None:
        """Close every role; the learner saves first."""
        for role in self.roles:
            role.close()
        self._progress_backup.keep(self.bus, at_once=True)


def train(config: RunConfig, folder: Path, watch: Callable[[Bus], None], stop: StopSignal, device: str = "cpu") -> None:
    """Train until the total is reached or ``stop`` is set; ``watch`` sees the bus about once a second."""
    run = Lockstep(config, folder, device)
    clock, due = BusyClock(), 0.0
    try:
        while not run.finished and not stop.requested:
            run.step()
            clock.busy()
            if time.monotonic() >= due:
                due = time.monotonic() + METRICS_PERIOD
                run.emit_metrics(clock)
                watch(run.bus)
        run.emit_metrics(clock)
        if run.finished:
            run.bus.emit(run.learner.name, {"finished": 1})
    finally:
        run.close()
        watch(run.bus)
