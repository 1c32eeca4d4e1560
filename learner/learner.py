"""The learner role: draw, update, give priorities back, publish weights, checkpoint, resume."""

import logging
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray
from torch import Tensor

from rmc.common.agent import initial_agent
from rmc.common.agent_config import AgentConfig
from rmc.common.bus.protocol import TAKEN_OVER, UNTRAINED, Bus, Version
from rmc.common.checkpoint import STATE, CheckpointFolder
from rmc.common.errors import CheckpointError, FencedError, RmcError, first_line
from rmc.common.policy_header import PolicyHeader
from rmc.common.replay import ObservationStatistics, Replay, Sample, SampleStatus
from rmc.common.window import WindowSpec
from rmc.learner.batch import clear_padding, importance_weights
from rmc.learner.broadcast import Broadcast
from rmc.learner.config import LearnerConfig, UpdateConfig
from rmc.learner.device_update import DeviceUpdate, HostCopy
from rmc.learner.learner_checkpoint import NOT_OURS, LearnerProgress, all_finite, pack, take_up
from rmc.learner.learner_metrics import Drawn, LearnerMetrics, needs_weights
from rmc.learner.pipelined_update import PipelinedUpdate
from rmc.learner.precision import set_precision
from rmc.learner.thread_trial import ThreadTrial
from rmc.learner.update import UpdateResult
from rmc.learner.update_order import make_update

log = logging.getLogger(__name__)
LARGE_REWARD = 1e4  # a step's, from which it is the likely cause of a divergence
SAVE_AGAIN_SECONDS = 10.0  # after a checkpoint that could not be written


class Learner:
    """Everything that learns. One ``step`` is one update.

    Lives on ``device``; takes up the newest valid checkpoint at once. Raises CheckpointError where
    checkpoints are there but none is valid.
    """

    name = "learner"

    def __init__(
        self,
        spec: WindowSpec,
        agent: AgentConfig,
        update: UpdateConfig,
        config: LearnerConfig,
        replay: Replay,
        bus: Bus,
        checkpoints: CheckpointFolder,
        seed: int,
        device: str = "cpu",
        header: PolicyHeader | None = None,
        threads: Sequence[int] = (),
        two_processes: bool = False,
    ) -> None:
        """``header`` goes into the policy's file of every checkpoint, with the steps so far; None: bare weights.

        Of ``threads``, ascending, the fastest is taken, after a trial; none: torch's stay. With ``two_processes`` each
        half of an update has one, and so many threads.
        """
        self.spec, self.config, self.replay, self.bus, self.checkpoints = spec, config, replay, bus, checkpoints
        self.device, self._header = torch.device(device), header
        self.updates = self.env_steps = self.last_checkpoint = self._checkpoint_steps = 0
        self.finished = False
        self._may_save = True
        self._observed_before = ObservationStatistics.none(spec)  # by the run that this one began with
        self._policy_learnt = False  # by that run
        self._waiting = ""
        self._largest_reward = 0.0  # that was learnt from, as it was scaled
        self._acting, self._evaluated = Broadcast(bus), Broadcast(bus, evaluate=True)
        self._save_at, self._checkpoint_error = 0.0, ""
        self._slowest, self._save_seconds = 0.0, checkpoints.last_save()  # of an update, of the last save
        self._make_networks(agent, update, seed, two_processes)
        self._threads, self._processes = ThreadTrial(threads, self._runner.use_threads), 1 + two_processes
        self._drawn: deque[Drawn] = deque()  # what is being learnt from
        self._metrics = LearnerMetrics(self.agent, spec, replay)
        self._returning: deque[tuple[NDArray[np.int64], HostCopy]] = deque()  # priorities, and of which windows
        self._begin()

    def _make_networks(self, agent: AgentConfig, update: UpdateConfig, seed: int, two_processes: bool) -> None:
        """The agent on its device, and its update, which runs here or has a process for each half."""
        torch.set_flush_denormal(True)  # into which Adam's moments of idle units decay: 13 % slower on a CPU
        self.agent = initial_agent(self.spec, agent, seed).to(self.device)
        bf16 = set_precision(self.config.precision, self.device)
        self.update = make_update(self.agent, update, seed, bf16)
        runner = PipelinedUpdate if two_processes else DeviceUpdate
        self._runner: DeviceUpdate | PipelinedUpdate = runner(self.update, self.spec, self.config.batch_size)

    def _begin(self) -> None:
        """Lock the checkpoints, go on from the newest, and become the run's one learner, in an epoch of its own.

        Raises ConfigError where another process has them locked, CheckpointError where none is valid.
        """
        self.checkpoints.lock()
        try:
            floor = max(self._resume(), self.checkpoints.last_epoch())
            self.epoch = self.bus.take_epoch(self.name, floor)
            self.checkpoints.note_epoch(self.epoch)
            self.replay.register_learner(self.epoch)
            self.publish()
        except BaseException:
            self.checkpoints.unlock()
            raise

    # Updating: a drawn sample's rows as bytes, to ``learner/update.py`` by way of the device or of two processes

    def step(self) -> bool:
        """Draw and update once, with all that is due after it. Raises FencedError where a newer learner has come."""
        if self.finished:
            return False
        try:
            return self._step()
        except FencedError:
            self._may_save = False
            raise
        except RmcError:  # Redis is away, or it has diverged: no update is half done
            raise
        except BaseException:
            self._may_save = False  # the halves of an update may be of two moments
            raise

    def _step(self) -> bool:
        self._acting.repeat_if_lost()
        self._evaluated.repeat_if_lost()
        sample = self.replay.sample(self.config.batch_size)
        self.env_steps = max(self.env_steps, sample.env_steps)
        if sample.status is not SampleStatus.BATCH:
            self._flush()
        if sample.status is SampleStatus.WAIT:
            self._waiting = "experience"
            return False
        if sample.status is SampleStatus.FINISHED:
            self._waiting = "disk"
            self.finished = self.checkpoint()
            return self.finished
        if self.updates + len(self._drawn) == 0:
            self._freeze_statistics()
        began = time.perf_counter()
        self._learn(sample)
        self._note_pace(time.perf_counter() - began)
        if self.env_steps >= self._next_checkpoint and time.monotonic() >= self._save_at:
            self._flush()
            self.checkpoint()
        return True

    def _learn(self, sample: Sample) -> None:
        rows = sample.rows
        assert rows is not None
        assert sample.weights is not None
        clear_padding(rows, self.spec)
        self._largest_reward = max(self._largest_reward, float(np.abs(rows["reward"]).max()))
        importance = importance_weights(sample.weights, self.config.importance_exponent)
        raw = torch.from_numpy(rows.view("u1").reshape(len(rows), -1))
        self._drawn.append(Drawn.of(rows, self.spec))
        number = self.updates + len(self._drawn)
        beta = self.update.config.beta(self.env_steps)
        for updated in self._runner(raw, torch.from_numpy(importance), beta, number):
            self._finish(updated)
        if number % self.config.publish_updates == 0 or needs_weights(number):
            self._finish_pending()

    def _note_pace(self, seconds: float) -> None:
        """Of an update: whoever ends this learner waits for those that are pending, and for a save."""
        self._threads.note(seconds)
        if seconds > 2.0 * self._slowest:
            self._slowest = seconds
            self.checkpoints.note_save(self._save_seconds + seconds)

    def _finish_pending(self) -> None:
        for updated in self._runner.drain():
            self._finish(updated)

    def _finish(self, updated: UpdateResult) -> None:
        """All that follows an update. Weights are read only where none is pending."""
        self.updates += 1
        drawn = self._drawn.popleft()
        self._returning.append((drawn.serial, HostCopy(updated.priorities)))
        self._return_priorities(leave=self._runner.in_flight)
        self._metrics.measure(self.updates, updated, drawn)
        if self.updates % self.config.publish_updates == 0:
            self.publish()

    def _flush(self) -> None:
        """Finish what is pending and give all priorities back."""
        self._finish_pending()
        self._return_priorities(leave=0)

    def _return_priorities(self, leave: int) -> None:
        """To the replay server, but for the newest so many, which a GPU still works on."""
        while len(self._returning) > leave:
            serials, priorities = self._returning.popleft()
            self.replay.update_priorities(serials, priorities.wait().numpy())

    # Publishing: weights to those that act

    def publish(self) -> None:
        """Broadcast the policy with the newest observation statistics frozen into it. Raises FencedError."""
        self._freeze_statistics()
        blob = self._serialize_finite(self.agent.broadcast_weights())
        version = Version(self.epoch, self.updates or (TAKEN_OVER if self._policy_learnt else UNTRAINED))
        self._acting.publish(version, blob)

    def _serialize_finite(self, weights: dict[str, Tensor], metadata: dict[str, str] | None = None) -> bytes:
        """Weights as they are sent and saved. Raises RmcError where they are not finite: neither must then happen."""
        self._check_finite(weights)
        return safetensors.torch.save(weights, metadata)

    def _metadata(self) -> dict[str, str] | None:
        if self._header is None:
            return None
        return replace(self._header, env_steps=self.env_steps, updates=self.updates).metadata()

    def _check_finite(self, state: Any) -> None:
        if not all_finite(state):
            self._may_save = False
            raise RmcError(f"update {self.updates}: training has diverged, weights are not finite; {self._remedy()}")

    def _remedy(self) -> str:
        """What to change after a divergence."""
        if self._largest_reward < LARGE_REWARD:
            return "lower --learning-rate"
        return f"rewards reach {self._largest_reward:.2g}: make --reward-scale that much smaller"

    def _freeze_statistics(self) -> None:
        """Of now; those of before while a replay server is away."""
        if self.agent.config.normalize_observations and self.env_steps > 0 and (own := self.replay.statistics()):
            statistics = own + self._observed_before
            sums = (statistics.count, statistics.total, statistics.total_square)
            self.agent.freeze_statistics(*(torch.from_numpy(numbers).to(self.device) for numbers in sums))

    # Saving and resuming

    def checkpoint(self) -> bool:
        """Save, and broadcast that: for an evaluation, and as what acts, since a resumed run begins with it, too.

        Whether it was saved: a disk that is full, or away, is tried again later, and training goes on until then.
        """
        if time.monotonic() < self._save_at:
            return False
        self._freeze_statistics()
        try:
            policy = self.save()
        except CheckpointError as error:
            log.warning("%s; trying again in %.0f s", error, SAVE_AGAIN_SECONDS)
            self._save_at = time.monotonic() + SAVE_AGAIN_SECONDS
            self._checkpoint_error = error.reason
            return False
        self._next_checkpoint = self._after(self.env_steps)
        try:
            self.publish()
        finally:  # an outage between the two costs neither
            self._evaluated.publish(Version(self.epoch, self.updates), policy)
        return True

    def save(self) -> bytes:
        """Write everything that a resumed learner needs; returns the policy's file.

        Raises CheckpointError where that cannot be, RmcError where any of it is not finite.
        """
        began = time.monotonic()
        state = self.update.state_dict()
        self._check_finite(state)  # critics or moments may be spoilt while the policy, for one more update, is not
        policy = self._serialize_finite(self.update.average.policy_weights(), self._metadata())
        progress = LearnerProgress(
            self.updates, self.env_steps, self.epoch, self._threads.found, self._observed_before, self._policy_learnt
        )
        self.checkpoints.save(self.updates, pack(state, policy, progress))
        self._save_seconds = time.monotonic() - began
        self.checkpoints.note_save(self._save_seconds + self._slowest)
        self.last_checkpoint, self._checkpoint_steps, self._checkpoint_error = self.updates, self.env_steps, ""
        return policy

    def _after(self, env_steps: int) -> int:
        return (env_steps // self.config.checkpoint_steps + 1) * self.config.checkpoint_steps

    def _resume(self) -> int:
        """Go on from the newest valid checkpoint; returns the epoch it was written in."""
        self._next_checkpoint = self.config.checkpoint_steps
        newest = self.checkpoints.latest()
        self._damaged_checkpoints = len(self.checkpoints.damaged)
        if newest is None:
            if self._damaged_checkpoints:
                raise CheckpointError(f"{self.checkpoints.folder}: no checkpoint is valid; restore one")
            return 0
        number, files = newest
        try:
            progress = take_up(files, self.update, self.device)
        except NOT_OURS as error:
            fault = f"{STATE} is not this run's ({first_line(error)})"
            raise CheckpointError(f"{self.checkpoints.path(number)}: {fault}") from None
        self.updates = self.last_checkpoint = progress.updates
        self.env_steps = self._checkpoint_steps = progress.env_steps
        self._threads.take_up(progress.threads)
        self._observed_before = progress.observed_before or self._observed_before
        self._policy_learnt = progress.policy_learnt
        self._next_checkpoint = self._after(self.env_steps)
        log.info("resumed at update %d, agent step %d", self.updates, self.env_steps)
        return progress.epoch

    # What the process asks

    def waiting_for(self) -> str:
        return self._waiting

    def metrics(self) -> dict[str, Any]:
        return {
            "updates": self.updates,
            "env_steps": self.env_steps,
            "beta": self.update.config.beta(self.env_steps),
            "epoch": self.epoch,
            "checkpoint_update": self.last_checkpoint,
            "checkpoint_env_steps": self._checkpoint_steps,
            "checkpoint_error": self._checkpoint_error,
            "damaged_checkpoints": self._damaged_checkpoints,
            "threads": self._threads.chosen * self._processes,
            "largest_reward": self._largest_reward,
            **self._metrics.take(self.updates),
        }

    def close(self) -> None:
        """Save what a resumed run needs, unless that is done, or was taken over, has diverged or broke in an update."""
        try:
            if self._may_save and not self.finished:
                self._flush()
                if self.updates > self.last_checkpoint:
                    self.save()
        except RmcError as error:  # diverged since the last look, or no room: the checkpoint before is kept
            log.warning("%s; the checkpoint of update %d is the last", error, self.last_checkpoint)
        self._runner.close()
        self.checkpoints.unlock()
