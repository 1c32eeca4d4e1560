"""What a learner asks of a replay server, whether it is behind a socket or in the same thread."""

from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from common.window import Rows

EPISODE_BYTES = 16 << 20  # of rows at most in the answer to ``Replay.episode``


class Draw(Enum):
    """How a request for a batch ended."""

    BATCH = "batch"
    WAIT = "wait"  # the limiter holds the draw back until more steps are in
    FINISHED = "finished"  # all steps are in and the replay ratio is spent


@dataclass(frozen=True)
class Sample:
    """One draw. ``rows`` and ``importance`` are None unless ``draw`` is BATCH.

    ``rows`` may be a view into a buffer that the next draw but one overwrites.
    """

    draw: Draw
    rows: Rows | None  # (B,)
    importance: NDArray[np.float32] | None  # (B,), divided by the batch's largest
    env_steps: int  # environment steps committed to the ring so far


@dataclass(frozen=True)
class ObservationStatistics:
    """Sums over every real, non-blank observation inserted once; ``total`` and ``total_square`` (O,) float64."""

    count: int
    total: NDArray[np.float64]
    total_square: NDArray[np.float64]


class Replay(Protocol):
    """A replay server as its learner sees it."""

    def sample(self, batch_size: int) -> Sample:
        """Draw a batch, or learn why there is none."""

    def update_priorities(self, serials: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """Give priorities back, (B,) each; those of evicted serials are dropped and counted."""

    def statistics(self) -> ObservationStatistics:
        """Running observation statistics."""

    def episode(self, serial: int) -> Rows | None:
        """The windows of one episode from its start to that one, oldest first; None where not all are there."""

    def stats(self) -> dict[str, Any]:
        """The server's counters, flat."""
