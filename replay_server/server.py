"""The replay server: streams in, committed ring, prioritized batches out, credit back to the actors.

Shapes: B batch, O observation. One thread does it all; ``step`` takes in one bounded round of entries.
"""

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rmc.common.bus.protocol import Bus, ReplayOwner, Version
from rmc.common.errors import RmcError
from rmc.common.metrics import Means, Rate
from rmc.common.replay import EPISODE_BYTES, ObservationStatistics, Sample, SampleStatus
from rmc.common.shard import WHOLE, Shard
from rmc.common.window import Rows, Slots, WindowSpec
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.credit import Credit
from rmc.replay_server.episode import find_episode
from rmc.replay_server.observation_sums import observation_sums
from rmc.replay_server.rate_limiter import RateLimiter
from rmc.replay_server.recovery import open_store
from rmc.replay_server.stream_reader import IngestBatch, StreamReader
from rmc.replay_server.takeover import take_over

log = logging.getLogger(__name__)
PRIORITY_FLOOR = 1e-6  # so that every window keeps a chance
LOOK_SECONDS = 0.1  # between looks at which weights are the newest: each waits for Redis


class ReplayServer:
    """The role ``replay``, or one of its shards, and the Replay protocol for a learner in the same thread.

    Opens or recovers the ring in ``folder``; ``slack_steps`` is how far actors may run ahead of the ratio
    and must cover what they may hold back unsent. Raises ConfigError (see ``open_store``), BusUnavailable,
    and FencedError from ``step`` when a newer replay server has taken over.
    """

    def __init__(
        self,
        spec: WindowSpec,
        config: ReplayConfig,
        folder: Path,
        seed: int,
        total_steps: int,
        actors: int,
        slack_steps: int,
        bus: Bus,
        shard: Shard = WHOLE,
    ) -> None:
        self.spec, self.bus, self.name = spec, bus, shard.role
        self._seed, self._shard = seed, shard
        self._own_actors = [actor for actor in range(actors) if shard.owns(actor)]
        self._share = len(self._own_actors) / actors  # of all that is collected
        self._reader = StreamReader(spec, bus, actors, shard)
        warmup_steps = shard.part(config.warmup_steps, actors)
        self.owner = ReplayOwner(self.name, self._open(folder, config, warmup_steps))
        self._limiter = RateLimiter(
            config.replay_ratio / self._share,  # a shard's steps are a share, what is drawn from all is the whole
            warmup_steps,
            shard.part(total_steps, actors) - self._store.ring.progress.begun_env_steps,
            shard.part(slack_steps, actors),
        )
        self._credit = Credit(bus, self.owner, self._limiter, self._own_actors)
        self._owes_acks = False  # of what was taken in when Redis went away
        self._buffers = [np.empty(0, spec.dtype)] * 2
        self._waiting_for, self._waiting_since = "", 0.0  # the learner, at the limiter
        self._refused_priorities = self._damaged_windows = 0
        self._newest: Version | None = None  # of the weights, when last looked at
        self._look_at = 0.0
        self._largest_lag = 0.0  # of what was inserted since the last metrics
        self._means, self._rates = Means(), {name: Rate() for name in ("env_steps", "windows", "draws")}

    def _open(self, folder: Path, config: ReplayConfig, warmup_steps: int) -> int:
        """Open or recover the ring; the epoch that begins with it. Raises as the class does, the ring closed again."""
        capacity = -(-config.capacity // self._shard.count)
        self._store = open_store(folder, self.spec, capacity, config.priority_exponent)
        try:
            return take_over(self._store, self.bus, self.name, self.spec, config.replay_ratio, warmup_steps)
        except BaseException:
            self._store.close()
            raise

    # Taking in: streams to the ring

    def step(self) -> bool:
        """Take in one round of entries: ring, commit, acks. False where there was none."""
        batch = self._reader.read(self._store.ring.progress.streams)
        if batch is not None:
            self._owes_acks = True
            self._insert(batch)
        self._credit.publish(self._store.ring.progress, self._owes_acks or bool(self._waiting_for))
        self._owes_acks = False
        if batch is None:
            return False
        for actor, before in batch.broken.items():
            self.bus.drop_stream(self.owner, actor)
            self._reader.sends_again(actor, before)
        return True

    def _insert(self, batch: IngestBatch) -> None:
        ring, progress, rows = self._store.ring, self._store.ring.progress, batch.rows
        sums = observation_sums(rows, self.spec, self.statistics())
        slots = ring.write(rows)
        progress.max_priority = self._store.largest_priority(slots)
        initial = rows["initial_priority"][-ring.capacity :]
        priorities = np.where(initial > 0, np.maximum(initial, PRIORITY_FLOOR), progress.max_priority)
        self._store.set_priorities(slots, priorities.astype(np.float32))
        progress.max_priority = max(progress.max_priority, float(initial.max(initial=0.0)))
        progress.env_steps += int(rows["new_steps"].sum())
        progress.observed += sums
        progress.streams = batch.positions
        ring.commit(len(rows))
        self._measure_lag(rows)

    def _measure_lag(self, rows: Rows) -> None:
        """Policy lag at insertion: weights versions between those that acted and the newest."""
        if len(rows) and time.monotonic() >= self._look_at:
            self._look_at = time.monotonic() + LOOK_SECONDS
            self._newest = self.bus.latest_version()
        if len(rows) and self._newest is not None:
            lag = np.maximum(self._newest.update - rows["weights_update"], 0)  # below 0 is of updates that a kill undid
            self._means.add("policy_lag_mean", float(lag.mean()))
            self._largest_lag = max(self._largest_lag, float(lag.max()))

    # Giving out: draws, and priorities back

    def register_learner(self, epoch: int) -> None:
        """The learner of the same thread has nobody beside it; of others the socket's server knows."""

    def sample(self, batch_size: int, drawn_elsewhere_steps: int = 0, out: Rows | None = None) -> Sample:
        """Draw (B,) rows in proportion to priority ** exponent, if the limiter lets it.

        The rows lie in ``out``, else in one of two buffers that draws take in turn. A draw depends on the seed, its
        number and the ring alone. Raises RmcError where every window is damaged.
        """
        progress, tree = self._store.ring.progress, self._store.tree
        progress.elsewhere_steps = max(progress.elsewhere_steps, drawn_elsewhere_steps)
        status = self._limiter.status(progress.inserted, progress.drawn, batch_size * self.spec.train)
        if status is SampleStatus.BATCH and tree.total == 0.0:
            status = SampleStatus.WAIT
        self._note_waiting(status)
        if status is not SampleStatus.BATCH:
            return Sample(status, None, None, tree.total, progress.env_steps, progress.drawn_steps)
        rows = self._buffer(batch_size) if out is None else out
        slots = self._draw_into(rows)
        if slots is None:  # actors without credit would wait for the learner, and it for them
            raise RmcError(f"{self.name}: every window of the ring is damaged; the next start begins with an empty one")
        progress.draws += 1
        progress.drawn_steps += self.spec.trained_steps(rows)
        self._store.ring.commit()
        values = tree.values(slots)
        return Sample(status, rows, values, tree.total, progress.env_steps, progress.drawn_steps)

    def _draw_into(self, rows: Rows) -> Slots | None:
        """Fill (B,) rows with sound windows and give their slots; None where none are left."""
        number = self._store.ring.progress.draws * self._shard.count + self._shard.index  # no shard's like another's
        random = np.random.Generator(np.random.Philox(key=np.array([self._seed, number], np.uint64)))
        while self._store.tree.total > 0.0:
            slots = self._store.tree.sample(len(rows), random)
            if self._gather(slots, rows):
                return slots
        return None

    def _gather(self, slots: Slots, rows: Rows) -> bool:
        """Copy windows; whether all are sound. What is not, which a disk has changed, is never drawn again."""
        sound = self._store.ring.gather(slots, rows)
        if sound.all():
            return True
        damaged = np.unique(slots[~sound])
        self._store.forget(damaged)
        self._damaged_windows += len(damaged)
        log.warning("%s: %d windows of the ring are damaged; they are never drawn again", self.name, len(damaged))
        return False

    def _buffer(self, batch_size: int) -> Rows:
        self._buffers.reverse()
        if len(self._buffers[0]) < batch_size:
            self._buffers[0] = np.empty(batch_size, self.spec.dtype)
        return self._buffers[0][:batch_size]

    def _note_waiting(self, status: SampleStatus) -> None:
        warming_up = self._store.ring.progress.inserted < self._limiter.warmup_steps
        waiting_for = ("warm-up" if warming_up else "env_steps") if status is SampleStatus.WAIT else ""
        if waiting_for != self._waiting_for:
            self._waiting_for, self._waiting_since = waiting_for, time.monotonic()

    def update_priorities(self, serials: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """New priorities of (B,) windows; those evicted since, and those not finite, are dropped and counted."""
        progress = self._store.ring.progress
        present = self._store.ring.holds(serials)
        usable = np.isfinite(priorities) & (priorities >= 0)
        progress.evicted_priorities += int((~present).sum())
        self._refused_priorities += int((present & ~usable).sum())
        kept = np.maximum(priorities[present & usable], PRIORITY_FLOOR, dtype=np.float32)
        if (largest := float(kept.max(initial=0.0))) > progress.max_priority:
            progress.max_priority = largest
            self._store.ring.commit()  # a restart believes no priority beyond it
        self._store.set_priorities(serials[present & usable] % self._store.ring.capacity, kept)

    def statistics(self) -> ObservationStatistics:
        """Running sums over all observations inserted so far."""
        return self._store.ring.progress.observed

    def episode(self, serial: int) -> Rows | None:
        """The windows of one episode from its start to that one; None where not all are there."""
        slots = find_episode(self._store.ring, serial, max(1, EPISODE_BYTES // self.spec.dtype.itemsize))
        if slots is None:
            return None
        rows: Rows = np.empty(len(slots), self.spec.dtype)
        return rows if self._gather(slots, rows) else None

    # What the process asks

    def stats(self) -> dict[str, Any]:
        """Counters, flat; who waits at the limiter, for what, since when."""
        progress, limiter = self._store.ring.progress, self._limiter
        return {
            "env_steps": progress.env_steps,
            "windows": progress.next_serial,
            "ring_fill": progress.windows / self._store.ring.capacity,
            "ring_windows": progress.windows,
            "ring_capacity": self._store.ring.capacity,
            "draws": progress.draws,
            "drawn_steps": progress.drawn_steps,
            "replay_ratio": limiter.ratio(progress.inserted, progress.drawn) * self._share,
            "replay_ratio_off": int(not limiter.is_held(progress.inserted, progress.drawn)),
            "credit_steps": max(0, limiter.limit(progress.drawn) - progress.inserted),
            "learner_waiting_for": self._waiting_for,
            "learner_waiting_s": time.monotonic() - self._waiting_since if self._waiting_for else 0.0,
            "max_priority": progress.max_priority,
            "evicted_priorities": progress.evicted_priorities,
            "refused_priorities": self._refused_priorities,
            "damaged_windows": self._damaged_windows,
            "entry_gaps": self._reader.gaps,
            "dead_letters": self._reader.refused.total(),
            **{f"dead_letters_{reason}": count for reason, count in self._reader.refused.items()},
        }

    def metrics(self) -> dict[str, Any]:
        """``stats`` with rates a second and the policy lag of what was inserted since the last call."""
        stats = self.stats()
        rates = {f"{name}_per_s": rate.take(stats[name]) for name, rate in self._rates.items()}
        lags = self._means.take()
        if lags:
            lags["policy_lag_max"], self._largest_lag = self._largest_lag, 0.0
        return {**stats, **rates, **lags}

    def waiting_for(self) -> str:
        """``windows`` from the actors where nothing may be drawn before more come, else ``draws`` by the learner."""
        progress = self._store.ring.progress
        return "windows" if self._limiter.status(progress.inserted, progress.drawn, 0) is SampleStatus.WAIT else "draws"

    def checkpoint(self) -> None:
        """Make everything durable: a server opened here afterwards goes on as this one would."""
        self._store.ring.commit()
        self._store.flush()

    def close(self) -> None:
        """Commit and unlock the folder."""
        self._store.ring.commit()
        self._store.close()
