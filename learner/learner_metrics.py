"""What the learner says of its updates, of the latent, and of how old what it learns from is.

Shapes: B batch.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from rmc.common.agent import Agent
from rmc.common.bus.metrics_record import MAX_LIST
from rmc.common.metrics import Means, Rate
from rmc.common.replay import Replay
from rmc.common.window import BoolArray, Rows, WindowSpec
from rmc.learner.diagnostics import SLICE, latent_rank, measurable, staleness
from rmc.learner.update import UpdateResult

METRICS_UPDATES = 20  # updates between looks at the update's metrics: each look waits for the device
INSIGHT_UPDATES = 500  # updates between looks at what takes longer: the latent's rank and the states' staleness
OF_MEMORY = {  # metrics of h
    "model_loss", "model_unexplained", "curiosity_mean", "curiosity_share", "latent_rank", "latent_deviation",
}  # fmt: skip


class Drawn(NamedTuple):
    """What is kept of a batch while it is learnt from; (B,) each."""

    serial: NDArray[np.int64]
    weights_update: NDArray[np.int64]
    measurable: BoolArray

    @classmethod
    def of(cls, rows: Rows, spec: WindowSpec) -> "Drawn":
        """Of (B,) rows, which may be overwritten then."""
        return cls(rows["serial"].copy(), rows["weights_update"].copy(), measurable(rows, spec))


def needs_weights(update: int) -> bool:
    """Whether the measurement after that update reads the agent's weights."""
    return update % INSIGHT_UPDATES == 1


class LearnerMetrics:
    """Gathers between two records."""

    def __init__(self, agent: Agent, spec: WindowSpec, replay: Replay) -> None:
        self._agent, self._spec, self._replay = agent, spec, replay
        self._means, self._rate = Means(), Rate()
        self._unexplained: list[float] = []  # of every observation dimension, since the last look at it

    def measure(self, update: int, updated: UpdateResult, drawn: Drawn) -> None:
        """After an update."""
        if update % METRICS_UPDATES == 0:
            age = np.maximum(update - drawn.weights_update, 0)  # below 0 is of updates that a kill undid
            self._add({"sample_age_mean": age.mean(), **updated.metrics})
        if needs_weights(update):
            rank, deviation = latent_rank(updated.hidden[updated.observed])
            self._add({"latent_rank": rank, "latent_deviation": deviation})
            self._unexplained = [round(share, 4) for share in updated.observation_unexplained.tolist()]
            if self._agent.config.head_input != "observation":
                self._measure_staleness(drawn)

    def _measure_staleness(self, drawn: Drawn) -> None:
        """How far stored states are from what today's weights would remember."""
        for serial in drawn.serial[drawn.measurable][:SLICE].tolist():
            episode = self._replay.episode(serial)
            if episode is not None:
                self._add(staleness(self._agent, self._spec, episode))

    def _add(self, values: Mapping[str, SupportsFloat]) -> None:
        """To the means; without a memory, h is zeros and there is nothing to say of it."""
        for name, value in values.items():
            if self._agent.config.head_input != "observation" or name not in OF_MEMORY:
                self._means.add(name, float(value))

    def take(self, updates: int) -> dict[str, Any]:
        """The metrics since the last call."""
        unexplained, self._unexplained = self._unexplained, []
        return {
            "updates_per_s": self._rate.take(updates),
            **({"observation_unexplained": unexplained} if 0 < len(unexplained) <= MAX_LIST else {}),
            **self._means.take(),
        }
