"""What actors are told: what of theirs is committed, and how far they may step."""

import time

from rmc.common.bus.protocol import Ack, Bus, ReplayOwner
from rmc.common.errors import RmcError
from rmc.replay_server.commit_record import Progress
from rmc.replay_server.rate_limiter import RateLimiter

REPUBLISH_PERIOD = 5.0  # seconds between repeats of all acks, in case Redis lost its data


class Credit:
    """Acks with the steps that the limiter grants, in equal parts to a server's own actors."""

    def __init__(self, bus: Bus, owner: ReplayOwner, limiter: RateLimiter, own_actors: list[int]) -> None:
        self._bus, self._owner, self._limiter, self._own_actors = bus, owner, limiter, own_actors
        self._published: dict[int, Ack] = {}
        self._republish_at = time.monotonic() + REPUBLISH_PERIOD

    def publish(self, progress: Progress, at_once: bool) -> None:
        """Publish acks that changed. Small changes wait, unless ``at_once``: then actors need all there is.

        The clock only ever repeats what was published, so that in lockstep it decides nothing.
        Raises BusUnavailable, BusFull, FencedError.
        """
        if self._published and time.monotonic() >= self._republish_at:
            self._bus.commit(self._owner, self._published, progress.publish())
            self._republish_at = time.monotonic() + REPUBLISH_PERIOD  # sooner where that failed
        acks = {actor: ack for actor, ack in self._acks(progress).items() if self._published.get(actor) != ack}
        quantum = max(1, self._limiter.slack_steps // (8 * len(self._own_actors)))
        at_once |= not self._published
        if acks and (at_once or any(self._grown(actor, ack) >= quantum for actor, ack in acks.items())):
            self._published.update(acks)  # before they are heard: Redis may take a commit whose answer never comes
            try:
                self._bus.commit(self._owner, acks, progress.publish())
            except RmcError:
                self._republish_at = 0.0
                raise

    def _acks(self, progress: Progress) -> dict[int, Ack]:
        """What every actor seen so far has committed, and how far it may step."""
        shares = self._limiter.shares(progress.inserted, progress.drawn, len(self._own_actors))
        granted = dict(zip(self._own_actors, shares, strict=True))
        final = self._limiter.is_final(progress.drawn)
        return {
            actor: Ack(at.id, at.settled_steps + granted.get(actor, 0), final) for actor, at in progress.streams.items()
        }

    def _grown(self, actor: int, ack: Ack) -> int:
        before = self._published.get(actor)
        return ack.granted_steps - (before.granted_steps if before is not None else 0)
