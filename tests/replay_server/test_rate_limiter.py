"""The limiter: the ratio is held in both directions, everything ends, and nobody waits for ever."""

import random
from dataclasses import dataclass

from hypothesis import given, settings
from hypothesis import strategies as st

from rmc.common.replay import SampleStatus
from rmc.replay_server.rate_limiter import RateLimiter

TRAIN = 5


@settings(max_examples=300)
@given(
    ratio=st.floats(0.1, 300.0),
    warmup=st.integers(0, 1000),
    total=st.integers(1, 5000),
    slack=st.integers(1, 500),
    inserted=st.integers(0, 6000),
    drawn=st.integers(0, 10**6),
    actors=st.integers(1, 9),
)
def test_bounds(ratio: float, warmup: int, total: int, slack: int, inserted: int, drawn: int, actors: int) -> None:
    limiter = RateLimiter(ratio, warmup, total, slack)
    shares = limiter.shares(inserted, drawn, actors)
    assert sum(shares) == max(0, limiter.limit(drawn) - inserted)
    assert max(shares) - min(shares) <= 1
    assert shares == sorted(shares, reverse=True)
    assert limiter.limit(drawn) <= total
    assert limiter.is_final(drawn) == (limiter.limit(drawn) == total)
    draw = limiter.status(inserted, drawn, 64)
    if inserted < min(warmup, total):
        assert draw is SampleStatus.WAIT
    if draw is SampleStatus.BATCH:
        assert drawn <= (inserted - warmup + slack) * ratio + 1e-6
    if draw is SampleStatus.WAIT:  # then the actors have at least the slack, or the rest of the run
        assert limiter.limit(drawn) - inserted >= min(slack, total - inserted) - 1
    if draw is SampleStatus.BATCH and limiter.limit(drawn) >= inserted:  # as in a run whose counters are whole
        assert limiter.is_held(inserted, drawn)
    if draw is SampleStatus.FINISHED:
        assert inserted >= total
        assert drawn + 64 > (inserted - warmup) * ratio


def test_final_debt_is_drawn_without_tolerance() -> None:
    limiter = RateLimiter(10.0, 100, 1000, 50)
    assert limiter.status(1000, 9000 - 64, 64) is SampleStatus.BATCH
    assert limiter.status(1000, 9001 - 64, 64) is SampleStatus.FINISHED
    assert limiter.status(999, 9001 - 64, 64) is SampleStatus.BATCH
    assert limiter.ratio(1000, 9000) == 10.0


@dataclass
class SimulatedActor:
    """Steps its environments while it has credit; sends a window each ``stride`` steps, all open ones at the end."""

    environments: int
    stride: int
    own: int = 0
    unsent: int = 0
    sent: int = 0

    def act(self, granted: int, final: bool) -> bool:
        """One vector step, or the last flush; False where it must wait."""
        if self.own < granted:
            self.own += self.environments
            self.unsent += self.environments
            if self.unsent == self.environments * self.stride:
                self.flush()
            return True
        if final and self.unsent:
            self.flush()
            return True
        return False

    def flush(self) -> None:
        self.sent, self.unsent = self.sent + self.unsent, 0

    def restart(self) -> None:
        self.own = self.unsent = self.sent = 0


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_never_deadlocks(data: st.DataObject) -> None:
    """Actors (some of whom die), server and learner in any order: the total is reached and the ratio spent."""
    actors = [
        SimulatedActor(data.draw(st.integers(1, 4)), data.draw(st.integers(1, 6)))
        for _ in range(data.draw(st.integers(1, 4)))
    ]
    slack = len(actors) * max(actor.environments * actor.stride for actor in actors)
    total, warmup = data.draw(st.integers(1, 300)), data.draw(st.integers(0, 200))
    batch = data.draw(st.integers(1, 8)) * TRAIN
    limiter = RateLimiter(data.draw(st.floats(0.2, 40.0)), warmup, total, slack)
    order = random.Random(data.draw(st.integers(0, 2**32)))
    inserted = drawn = 0
    settled = [0] * len(actors)  # what the server has taken in of each actor's present life
    finished = False
    while not finished:
        moved = False
        for index in order.sample(range(-1, len(actors)), len(actors) + 1):
            if index < 0:
                draw = limiter.status(inserted, drawn, batch)
                drawn += (batch - order.randrange(TRAIN)) * (draw is SampleStatus.BATCH)  # short windows count less
                finished |= draw is SampleStatus.FINISHED
                moved |= draw is not SampleStatus.WAIT
                continue
            if order.random() < 0.01:
                actors[index].restart()
                settled[index] = 0
            for _ in range(order.randrange(1, 20)):
                share = limiter.shares(inserted, drawn, len(actors))[index]
                moved |= actors[index].act(settled[index] + share, limiter.is_final(drawn))
                inserted += actors[index].sent - settled[index]
                settled[index] = actors[index].sent
        assert moved, f"all wait: {inserted} of {total} inserted, {drawn} drawn"
    assert total <= inserted <= total + 2 * slack
    if total > warmup:
        assert drawn > (total - warmup) * limiter.replay_ratio - batch
        assert drawn <= (inserted - warmup + slack) * limiter.replay_ratio + batch


def test_a_ratio_far_from_its_target_is_not_held() -> None:
    limiter = RateLimiter(2.0, 1000, 10**6, 160)
    assert limiter.is_held(0, 0)
    assert limiter.is_held(1160, 0)  # the warm-up is in, the first draw not made
    assert limiter.is_held(5000, 8000)
    assert not limiter.is_held(5000, 2**30)  # what one row's damaged size once added
    assert not limiter.is_held(5000, 0)
    assert not limiter.is_held(2**40, 8000)
