"""What the learner says of its updates, where there is something to say."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.learner.config import UpdateConfig
from rmc.learner.learner_metrics import INSIGHT_UPDATES, METRICS_UPDATES, Drawn, LearnerMetrics
from rmc.learner.update_order import make_update
from tests.learner.agents import PAPER
from tests.learner.rows import SPEC, random_rows, to_batch

OF_MEMORY = {
    "model_loss", "model_unexplained", "curiosity_mean", "curiosity_share", "latent_rank", "latent_deviation",
}  # fmt: skip


class NoEpisodes:
    """A replay whose episodes are overwritten."""

    asked = 0

    def episode(self, serial: int) -> None:
        NoEpisodes.asked += 1


def measured(config: AgentConfig, acted: list[int]) -> dict[str, Any]:
    """Of one update, taken for two, from windows of policies of these updates."""
    agent, rows = Agent(SPEC.obs_dim, SPEC.action_dim, config), random_rows(len(acted))
    rows["weights_update"], rows["episode_step"] = acted, SPEC.burn_in + 1
    metrics = LearnerMetrics(agent, SPEC, NoEpisodes())  # type: ignore[arg-type]
    updated = make_update(agent, UpdateConfig(scheme=2), 3)(to_batch(rows), torch.tensor(0.0))
    for number in (METRICS_UPDATES, INSIGHT_UPDATES + 1):
        metrics.measure(number, updated, Drawn.of(rows, SPEC))
    return metrics.take(1)


@pytest.mark.parametrize(("head_input", "said"), [("hidden", OF_MEMORY), ("observation", set())])
def test_without_a_memory_nothing_is_said_of_it(head_input: Any, said: set[str]) -> None:
    asked = NoEpisodes.asked
    metrics = measured(dataclasses.replace(PAPER, head_input=head_input), [0] * 40)
    assert metrics.keys() & OF_MEMORY == said
    assert (NoEpisodes.asked > asked) == bool(said)  # for staleness
    assert "q_loss" in metrics


def test_a_window_of_an_update_that_a_kill_undid_is_new() -> None:
    acted = [METRICS_UPDATES + 7, METRICS_UPDATES, METRICS_UPDATES - 4, METRICS_UPDATES - 6]
    metrics = measured(PAPER, acted)
    assert metrics["sample_age_mean"] == np.mean([0, 0, 4, 6])
    assert measured(PAPER, acted[:1])["sample_age_mean"] == 0
