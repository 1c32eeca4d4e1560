"""Every role in one thread over the in-process bus: same seed, same bits. For debugging and tests."""

import itertools
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rmc.actors.actor import Actor
from rmc.actors.evaluator import Evaluator
from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.protocol import Bus
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.env.make import make_env
from rmc.common.metrics import BusyClock
from rmc.common.process.role import METRICS_PERIOD, Role, StopSignal
from rmc.deploy.local.actor_process import initial_priority
from rmc.deploy.run.config import RunConfig
from rmc.learner.learner import Learner
from rmc.replay_server.server import ReplayServer


class Lockstep:
    """A whole run, stepped in a fixed order: the learner while the limiter lets it, else the actors.

    Checkpoints drop unfinished episodes and reseed the environments, whether or not the run stops
    there: only so can stop-and-resume give the same bits for any environment.
    """

    def __init__(self, config: RunConfig, folder: Path, device: str = "cpu") -> None:
        spec, self.bus = config.window_spec(), MemoryBus()
        self.server = ReplayServer(
            spec,
            config.replay,
            folder / "replay",
            config.seed,
            config.total_steps,
            config.actors,
            config.slack_steps(),
            self.bus,
        )
        self.server.step()  # publishes what a resumed ring has seen, from which actors take their epochs
        checkpoints = CheckpointFolder(folder / "checkpoints", config.learner.keep_checkpoints)
        self.learner = Learner(
            spec,
            config.agent,
            config.update,
            config.learner,
            self.server,
            self.bus,
            checkpoints,
            config.seed,
            device,
            config.policy_header(),
        )
        ticks = itertools.count()  # timers count calls, so that no clock decides anything
        self.actors = [
            Actor(
                index,
                config.seed,
                lambda: make_env(config.env, privileged=config.agent.privileged_critic),
                spec,
                config.agent,
                config.actor,
                self.bus,
                clock=lambda: float(next(ticks)),
                priority_fn=initial_priority(config, index),
            )
            for index in range(config.actors)
        ]
        self.evaluator = (
            self._evaluator(config, clock=lambda: float(next(ticks))) if config.evaluator.episodes else None
        )
        self._last_checkpoint = self.learner.last_checkpoint
        self._restart_due = False

    def _evaluator(self, config: RunConfig, clock: Callable[[], float]) -> Evaluator:
        uncut = replace(config.evaluator, evaluation_seconds=0.0)  # no clock decides this, either
        missing = config.layout.missing
        return Evaluator(config.seed, lambda: make_env(config.env), config.agent, uncut, self.bus, clock, missing)

    @property
    def roles(self) -> list[Role]:
        return [self.learner, self.server, *self.actors, *([self.evaluator] if self.evaluator else [])]

    def step(self) -> None:
        """One update, or one round of collection where none is due."""
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
        while self.evaluator is not None and self.evaluator.step():
            pass
        self.server.checkpoint()
        self._restart_due = True

    def emit_metrics(self, clock: BusyClock) -> None:
        """Of every role; all have one thread, and so its shares."""
        for role in self.roles:
            self.bus.emit(role.name, {"time": time.time(), **role.metrics(), **clock.shares()})

    def close(self) -> None:
        """Close every role; the learner saves first."""
        for role in self.roles:
            role.close()


def train(config: RunConfig, folder: Path, watch: Callable[[Bus], None], stop: StopSignal, device: str = "cpu") -> None:
    """Train until the total is reached or ``stop`` is set; ``watch`` sees the bus about once a second."""
    run = Lockstep(config, folder, device)
    clock, due = BusyClock(), 0.0
    try:
        while not run.learner.finished and not stop.requested:
            run.step()
            clock.busy()
            if time.monotonic() >= due:
                due = time.monotonic() + METRICS_PERIOD
                run.emit_metrics(clock)
                watch(run.bus)
        run.emit_metrics(clock)
    finally:
        run.close()
        watch(run.bus)
