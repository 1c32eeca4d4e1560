"""The rate limiter: ties updates to collection, in both directions. Pure arithmetic, no state.

    draw allowed:  drawn + B L_t <= (inserted - warm-up) * ratio + tolerance   and inserted >= warm-up
    actors' limit: warm-up + drawn / ratio + slack, at most the run's total; actors share what is left

drawn: trained steps drawn; inserted: agent steps. The tolerance is one batch and the slack's worth of
steps. When the learner waits, the actors' limit is at least ``slack`` above what is inserted; so nobody
waits for the other for ever where the slack covers the steps that actors may hold back unsent
(actors * environments * trained steps of a window: an episode's first window is sent when it is full).
"""

from dataclasses import dataclass

from rmc.common.replay import SampleStatus


@dataclass(frozen=True)
class RateLimiter:
    """Steps of the run, and trained steps drawn per agent step inserted."""

    replay_ratio: float
    warmup_steps: int
    total_steps: int
    slack_steps: int

    def status(self, inserted: int, drawn: int, batch_steps: int) -> SampleStatus:
        """Whether a batch of at most ``batch_steps`` trained steps may be drawn now.

        Once all steps are in, what the ratio still owes is drawn without the tolerance.
        """
        owed = (inserted - self.warmup_steps) * self.replay_ratio - drawn - batch_steps
        if inserted >= self.total_steps:
            return SampleStatus.BATCH if owed >= 0 else SampleStatus.FINISHED
        tolerance = batch_steps + self.slack_steps * self.replay_ratio
        return SampleStatus.BATCH if inserted >= self.warmup_steps and owed + tolerance >= 0 else SampleStatus.WAIT

    def limit(self, drawn: int) -> int:
        """Agent steps that all actors together may insert."""
        return min(self.total_steps, self.warmup_steps + int(drawn / self.replay_ratio) + self.slack_steps)

    def is_final(self, drawn: int) -> bool:
        """Whether the actors' limit is the end of the run."""
        return self.limit(drawn) == self.total_steps

    def shares(self, inserted: int, drawn: int, actors: int) -> list[int]:
        """What each of the actors may insert beyond what it has: equal parts, the rest to the low ids."""
        each, rest = divmod(max(0, self.limit(drawn) - inserted), actors)
        return [each + (actor < rest) for actor in range(actors)]

    def is_held(self, inserted: int, drawn: int) -> bool:
        """Whether the ratio is within half and twice its target, but for the slack; else a counter is damaged."""
        due, slack = (inserted - self.warmup_steps) * self.replay_ratio, 2 * self.slack_steps * self.replay_ratio
        return due / 2 - slack <= drawn <= 2 * max(due, 0.0) + slack

    def ratio(self, inserted: int, drawn: int) -> float:
        """The ratio held so far, counted from the end of the warm-up."""
        return drawn / max(1, inserted - self.warmup_steps)
