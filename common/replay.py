"""What a learner asks of a replay server, whether it is behind a socket or in the same thread."""

from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from rmc.common.window import Rows, WindowSpec

EPISODE_BYTES = 16 << 20  # of rows at most in the answer to ``Replay.episode``


class SampleStatus(Enum):
    """How a request for a batch ended."""

    BATCH = "batch"
    WAIT = "wait"  # the limiter holds the draw back until more steps are in
    FINISHED = "finished"  # all steps are in and the replay ratio is spent


@dataclass(frozen=True)
class Sample:
    """One draw. ``rows`` and ``weights`` are None unless ``status`` is BATCH.

    ``rows`` may be a view into a buffer that the next draw but one overwrites. What was drawn is in proportion to
    ``weights``, priority ** exponent each, of ``total_weight`` over all windows.
    """

    status: SampleStatus
    rows: Rows | None  # (B,)
    weights: NDArray[np.float64] | None  # (B,)
    total_weight: float
    env_steps: int  # agent steps committed to the ring so far
    drawn_steps: int  # trained steps drawn so far


EMPTY_SAMPLE = Sample(SampleStatus.WAIT, None, None, 0.0, 0, 0)  # of a server that was not heard yet


@dataclass(frozen=True)
class ObservationStatistics:
    """Sums over every real number inserted once that is not missing, of D numbers by C counts (see ``WindowSpec``).

    ``count`` (C,) int64; ``total`` and ``total_square`` (D,) float64: observations, then what is privileged.
    """

    count: NDArray[np.int64]
    total: NDArray[np.float64]
    total_square: NDArray[np.float64]

    @classmethod
    def none(cls, spec: WindowSpec) -> Self:
        """Of no observation."""
        return cls(np.zeros(spec.counts, np.int64), np.zeros(spec.statistics), np.zeros(spec.statistics))

    @classmethod
    def from_json(cls, raw: dict[str, Any]) -> Self:
        """The inverse of ``to_json``; of format 2, too, whose count is one number. Raises KeyError, TypeError,
        ValueError.
        """
        sums = (np.asarray(raw[name], np.float64) for name in ("total", "total_square"))
        return cls(np.atleast_1d(np.asarray(raw["count"], np.int64)), *sums)

    def to_json(self) -> dict[str, Any]:
        """As plain numbers and lists."""
        names = ("count", "total", "total_square")
        return {name: getattr(self, name).tolist() for name in names}

    def __add__(self, other: Self) -> Self:
        """Of the observations of both."""
        count, total = self.count + other.count, self.total + other.total
        return type(self)(count, total, self.total_square + other.total_square)


class Replay(Protocol):
    """A replay server as its learner sees it."""

    def register_learner(self, epoch: int) -> None:
        """Say which learner asks, before it asks: those of smaller epochs are served no more, and hear FencedError."""

    def sample(self, batch_size: int, drawn_elsewhere_steps: int = 0) -> Sample:
        """Draw a batch, or learn why there is none.

        ``drawn_elsewhere_steps`` are the trained steps drawn from other shards so far.
        """

    def update_priorities(self, serials: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """Give priorities back, (B,) each; those of evicted serials are dropped and counted."""

    def statistics(self) -> ObservationStatistics | None:
        """Running observation statistics; None while there is nobody to ask."""

    def episode(self, serial: int) -> Rows | None:
        """The windows of one episode from its start to that one, oldest first; None where not all are there."""
