"""The actor: steps N environments with the newest policy and sends what happens as windows.

Shapes: N environments, O observation, A action, S state (see ``AgentConfig.state_size``), M flags of what is missing,
P privileged numbers.
"""

import hashlib
import logging
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, Protocol

import numpy as np

from rmc.actors.config import ActorConfig
from rmc.actors.env_pool import EnvPool
from rmc.actors.policy_runner import PolicyRunner
from rmc.actors.unacked_entries import UnackedEntries
from rmc.actors.window_builder import WindowBuilder
from rmc.common.agent_config import AgentConfig
from rmc.common.bus.protocol import TAKEN_OVER, UNTRAINED, Ack, Bus, Version, actor_role
from rmc.common.env.wrappers import Env
from rmc.common.errors import BusFull, BusUnavailable, FencedError, MessageError
from rmc.common.metrics import Means, Rate
from rmc.common.window import Floats, Rows, WindowSpec

log = logging.getLogger(__name__)
POLL_SECONDS = 0.02  # between looks at the bus while there is nothing to do but wait
RESEND_SECONDS = 5.0  # without a new acknowledgement before everything unacknowledged is sent again
DOUBT_SECONDS = 10.0  # for which an acknowledgement older than the last is ignored; the replay repeats its own sooner
_NOISE, _RATING = -1, -2  # seeds beside the environments': of exploration, and of how windows are rated


class PriorityFn(Protocol):
    """Gives windows their initial priority."""

    def load(self, blob: bytes) -> None:
        """Take over broadcast weights."""

    def reseed(self, seed: int) -> None:
        """Begin the random numbers anew, before the first call."""

    def __call__(self, rows: Rows) -> Floats:
        """(n,) windows -> (n,) priorities."""


def environment_seed(run_seed: int, actor: int, epoch: int, env: int) -> int:
    """A seed that hardly any other environment, actor or restart of the run has; 31 bits, as environments take."""
    text = f"{run_seed} {actor} {epoch} {env}".encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "big") >> 33


class Actor:
    """A role: one ``step`` is one step of all its environments, or none of them.

    It steps while its steps of this epoch are below what the replay server granted, so it passes its grant by
    less than N. An error of the bus leaves it such that the next ``step`` goes on: nothing is lost or done twice.
    Raises FencedError where a newer actor has taken its place.
    """

    def __init__(
        self,
        index: int,
        seed: int,
        make_env: Callable[[], Env],
        spec: WindowSpec,
        agent: AgentConfig,
        config: ActorConfig,
        bus: Bus,
        clock: Callable[[], float] = time.monotonic,
        priority_fn: PriorityFn | None = None,
    ) -> None:
        """``clock`` times polls and the chunk's timer; a lockstep run passes one that counts calls.

        Without a ``priority_fn`` windows enter the replay with the largest priority that is there.
        """
        self.name = actor_role(index)
        self._index, self._seed, self._spec, self._config, self._hidden = index, seed, spec, config, agent.hidden
        self._bus, self._clock, self._priority_fn = bus, clock, priority_fn
        self._runner = PolicyRunner(spec.obs_dim, spec.action_dim, agent, config.envs_per_actor, spec.missing)
        self._envs = EnvPool(make_env, config.envs_per_actor, spec, self.name, config.reward_scale)
        self._means, self._rate, self._episodes = Means(), Rate(), 0
        self._refused_weights = 0
        self._refused: Version | None = None  # the last policy that was
        self._total_steps = 0
        try:
            self._start_epoch()
        except BaseException:
            self._envs.close()
            raise

    def restart(self) -> None:
        """Forget unfinished episodes and what was not sent, and begin a new epoch with new seeds and newest weights."""
        self._start_epoch(self._unacked.resends)

    def _start_epoch(self, resends: int = 0) -> None:
        ack = self._bus.ack(self._index)
        epoch = self._bus.take_epoch(self.name, floor=ack.id.epoch if ack else 0)
        self._unacked = UnackedEntries(self._bus, self._index, epoch, self._spec, resends)
        self._ack: Ack | None = None
        self._older_since = float("inf")
        self._version: Version | None = None
        self._epoch_steps = 0
        self._refresh_at = self._config.refresh_steps
        self._next_poll = self._chunk_due = float("-inf")
        self._resend_at = self._clock() + RESEND_SECONDS
        self._waiting_for = "weights"
        n = self._config.envs_per_actor
        strategy, capacity = self._config.state_strategy, self._config.chunk_windows + n
        stride = self._config.stride or self._spec.train
        self._builder = WindowBuilder(self._spec, stride, n, capacity, store_states=strategy in ("stored", "burn-in"))
        seed_of = partial(environment_seed, self._seed, self._index, epoch)
        self._rng = np.random.default_rng(seed_of(_NOISE))
        if self._priority_fn is not None:
            self._priority_fn.reseed(seed_of(_RATING))
        self._returns = np.zeros(n)
        self._lengths = np.zeros(n, np.int64)
        self._envs.restart(seed_of)
        for env in range(n):
            self._begin_episode(env)
        with suppress(BusUnavailable, BusFull):  # the hello; ``step`` tries again
            self._unacked.send()

    def step(self) -> bool:
        """One step of all environments; False where weights, credit or acknowledgements are missing."""
        self._send()
        if not self._may_step():
            return False
        self._step_environments()
        self._send_when_due()
        return True

    def waiting_for(self) -> str:
        return self._waiting_for

    def metrics(self) -> dict[str, Any]:
        """Flat metrics since the last call; episode means only where an episode ended."""
        record: dict[str, Any] = {
            "env_steps": self._total_steps,
            "steps_per_s": self._rate.take(self._total_steps),
            "episodes": self._episodes,
            "weights_update": self._version.update if self._version else -1,
            "unacked_entries": len(self._unacked),
            "resends": self._unacked.resends,
            "broken_episodes": self._envs.broken,
            "refused_weights": self._refused_weights,
        }
        return record | self._means.take()

    def close(self) -> None:
        """Send finished windows if the bus takes them, and close the environments."""
        with suppress(BusUnavailable, BusFull, FencedError):
            self._flush()
        self._envs.close()

    # Waiting: weights, credit, acknowledgements

    def _may_step(self) -> bool:
        if self._version is not None and self._epoch_steps >= self._refresh_at:
            self._refresh_weights()
        self._waiting_for = self._obstacle()
        if self._waiting_for and self._clock() >= self._next_poll:
            self._next_poll = self._clock() + POLL_SECONDS
            self._look_at_bus()
            self._waiting_for = self._obstacle()
        return not self._waiting_for

    def _obstacle(self) -> str:
        """What is missing for a step; empty if nothing is."""
        if self._version is None:
            return "weights"
        if self._unacked.bytes >= self._config.unacked_bytes:
            return "acknowledgements"
        if self._ack is None or self._epoch_steps >= self._ack.granted_steps:
            return "the end" if self._ack and self._ack.final else "credit"
        return ""

    def _look_at_bus(self) -> None:
        if self._version is None:
            self._refresh_weights()
        self._flush()
        self._poll_ack()
        if self._obstacle() == "the end" and self._builder.open:
            self._cut_episodes()

    def _refresh_weights(self) -> None:
        newest = self._bus.latest_version()
        self._refresh_at = self._epoch_steps + self._config.refresh_steps
        if newest is None or newest in (self._version, self._refused):
            return
        if self._version is not None and newest.epoch == self._version.epoch:
            self._means.add("policy_lag", newest.update - self._version.update)
        if self._version is None or newest > self._version:
            self._take_weights(self._bus.weights())

    def _take_weights(self, newest: tuple[Version, bytes] | None) -> None:
        """A policy that cannot be read is refused, once, and the one before goes on."""
        if newest is None:
            return
        try:
            if self._priority_fn is not None:
                self._priority_fn.load(newest[1])  # first: a refused policy does not act
            self._runner.load(newest[1])
        except MessageError as error:
            self._refused_weights += 1
            self._refused = newest[0]
            log.warning("%s: refused %s: %s", self.name, newest[0], error)
        else:
            self._version = newest[0]

    def _poll_ack(self) -> None:
        now = self._clock()
        ack = self._believed(self._bus.ack(self._index), now)
        if ack is not None and self._is_forgotten(ack):
            log.warning("%s: the replay server does not know epoch %d any more", self.name, self._unacked.epoch)
            self.restart()
            return
        if ack is not None and ack.id.epoch == self._unacked.epoch:
            self._ack = ack
            if self._unacked.acknowledge(ack):
                self._resend_at = now + RESEND_SECONDS
        if now >= self._resend_at:  # a Redis that came back empty has lost what the replay server never saw
            self._unacked.send_again()
            self._resend_at = now + RESEND_SECONDS

    def _believed(self, ack: Ack | None, now: float) -> Ack | None:
        """An ack, but for a while none older than the last: a Redis that came back as it was hears of the newest soon.

        One that stays is a ring's that has forgotten the newest.
        """
        older = ack is not None and self._ack is not None and ack.id < self._ack.id
        self._older_since = min(self._older_since, now) if older else float("inf")
        return None if older and now < self._older_since + DOUBT_SECONDS else ack

    def _is_forgotten(self, ack: Ack) -> bool:
        """Whether Redis has forgotten an incarnation of this actor that the ring knows, or the ring has forgotten ours.

        The former: our epoch is too small (before its first credit one has sent its hello alone). The latter: we
        are granted less than what was acknowledged. Raises FencedError where a newer one is real.
        """
        epoch = self._unacked.epoch
        if ack.id.epoch != epoch:
            if ack.id.epoch > epoch and self._bus.current_epoch(self.name) > epoch:
                raise FencedError(f"{self.name}: epoch {ack.id.epoch} has replaced epoch {epoch}")
            return ack.id.epoch > epoch
        return (self._ack is None and ack.id.seq > 0) or ack.granted_steps < self._unacked.committed_steps

    # Stepping

    def _step_environments(self) -> None:
        assert self._version is not None
        now, n = self._builder.now(), len(self._envs)
        noise = self._rng.standard_normal((n, self._spec.action_dim), np.float32)
        action, state = self._runner.act(*now, noise)
        if self._version.update == UNTRAINED:
            action = self._rng.uniform(-1.0, 1.0, action.shape).astype(np.float32)
        if not self._runner.knows_statistics:
            state[:, self._hidden :] = 0.0  # no frame was seen, as nothing normalises it yet
        transitions, faults = self._envs.step(action)
        for i in faults:
            self._builder.end_before(i)
            self._epoch_steps -= 1
            self._total_steps -= 1
        scaled = transitions._replace(reward=self._config.reward_scale * transitions.reward)
        ended = self._builder.add(action, state, self._version.update, scaled)
        self._next_poll = float("-inf")
        self._epoch_steps += n
        self._total_steps += n
        self._returns += transitions.reward
        self._lengths += 1
        for env in np.flatnonzero(ended).tolist():
            self._end_episode(env)
        for env, error in faults.items():  # such an episode ends with the step before
            self._envs.replace(env, error, int(self._lengths[env]))
            self._begin_episode(env)

    def _end_episode(self, env: int) -> None:
        self._episodes += 1
        self._means.add("episode_return_mean", float(self._returns[env]))
        self._means.add("episode_length_mean", int(self._lengths[env]))
        self._begin_episode(env)

    def _begin_episode(self, env: int) -> None:
        self._builder.begin(env, *self._envs.begin(env))
        self._returns[env] = self._lengths[env] = 0

    def _cut_episodes(self) -> None:
        """The run's last steps are in: send what is open as if its time limit had come."""
        self._builder.cut()
        for env in range(len(self._envs)):
            self._begin_episode(env)
        self._flush()

    # Sending

    def _send_when_due(self) -> None:
        count, now = self._builder.count, self._clock()
        if count == 0:
            self._chunk_due = now + self._config.chunk_seconds
        elif count >= self._config.chunk_windows or now >= self._chunk_due:
            self._flush()

    def _flush(self) -> None:
        if self._builder.count:
            rows = self._builder.take()
            if self._priority_fn is not None:
                learnt = rows["weights_update"] > TAKEN_OVER  # what untrained critics say means nothing
                rows["initial_priority"] = np.where(learnt, self._priority_fn(rows), 0.0)
            self._unacked.put(rows)
        self._send()

    def _send(self) -> None:
        if self._unacked.send():
            self._poll_ack()
