"""Every variant of the update against the plain reference: three updates, their losses, priorities and parameters."""

import copy
import dataclasses
from itertools import product

import numpy as np
import pytest
import torch

from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.common.window import WindowSpec
from rmc.learner.config import UpdateConfig
from rmc.learner.update_order import make_update
from tests.learner.agents import PAPER
from tests.learner.plain_update import PlainUpdate
from tests.learner.rows import BY_NUMBER, SPEC, random_rows, to_batch

ROBUST = AgentConfig(
    hidden=SPEC.state,
    embedding=7,
    heads=(10, 9),
    head_input="hidden+observation",
    normalize_observations=True,
    missing_flag=True,
)
NAMES = {
    "M": "model_loss", "G": "grounding_loss", "F": "fill_loss",
    "V": "q_loss", "P": "policy_loss", "T": "temperature_loss",
}  # fmt: skip
BETA = 0.5
VARIANTS = [
    *({"scheme": scheme} for scheme in (1, 2, 3, 4, 5, 6)),
    {"scheme": 4, "policy_through_q": False},
    {"scheme": 5, "policy_through_q": False},
    {"scheme": 6, "policy_through_q": False},
    {"update_order": "alternate"},
    {"update_order": "alternate", "scheme": 4},
    {"update_order": "alternate", "scheme": 4, "curiosity_scale": "std"},
    {"model_norm": "l2"},
    {"latent_target": "ema"},
    {"target_memory": "ema"},
    {"latent_target": "ema", "target_memory": "ema", "scheme": 4},
    {"policy_q": "first"},
    {"target_entropy": -0.5},
    {"curiosity_scale": "std"},
    {"n_step": 2},
    {"n_step": 9},
    {"clip_norm": 0.3},
    {"clip_norm": 40.0},
    {"memory_learning_scale": 0.1},
    {"gamma": 0.5, "polyak": 0.9, "eta": 0.3, "target_memory": "ema"},
]


NORMED = dataclasses.replace(ROBUST, critic_batch_norm=True, impute_missing=True)
AGENTS = [PAPER, ROBUST, NORMED]
OTHERS = [
    dataclasses.replace(ROBUST, head_input="hidden"),
    dataclasses.replace(ROBUST, head_input="observation"),
    dataclasses.replace(ROBUST, head_input="hidden", impute_missing=True),
    dataclasses.replace(ROBUST, head_input="observation", impute_missing=True),
]


@pytest.mark.parametrize("agent", AGENTS, ids=["paper", "robust", "normed"])
@pytest.mark.parametrize("options", VARIANTS, ids=lambda options: "-".join(f"{k}={v}" for k, v in options.items()))
def test_three_updates_are_those_of_the_equations(agent: AgentConfig, options: dict[str, object]) -> None:
    assert_same_updates(SPEC, agent, options)


@pytest.mark.parametrize(("sizes", "agent"), [*product([SPEC], OTHERS), *product([BY_NUMBER], AGENTS + OTHERS)])
@pytest.mark.parametrize("options", [{}, {"update_order": "alternate", "scheme": 4}, {"target_memory": "ema"}])
def test_so_they_are_for_every_agent(sizes: WindowSpec, agent: AgentConfig, options: dict[str, object]) -> None:
    assert_same_updates(sizes, agent, options)


def assert_same_updates(sizes: WindowSpec, agent: AgentConfig, options: dict[str, object]) -> None:
    torch.manual_seed(0)
    network = Agent(SPEC.obs_dim, SPEC.action_dim, agent, sizes.missing, sizes.privileged)
    total = torch.ones(sizes.statistics)
    network.freeze_statistics(torch.tensor([10]), total, 20.0 * total)
    config = UpdateConfig(curiosity=BETA, learning_rate=1e-2, **options)  # type: ignore[arg-type]
    plain = PlainUpdate(copy.deepcopy(network), SPEC.burn_in, config, seed=3)
    update = make_update(network, config, seed=3)
    spec = dataclasses.replace(sizes, state=agent.state_size(SPEC.obs_dim))
    for turn in range(3):
        rows, importance = random_rows(4, turn, spec), np.linspace(0.3, 1.0, 4).astype(np.float32)
        expected, priorities = plain(rows, importance, BETA)
        result = update(to_batch(rows, spec, importance), torch.tensor(BETA))
        trained = {NAMES["G"]: agent.grounding, NAMES["F"]: agent.impute_missing}
        assert result.metrics.keys() >= {name for name in NAMES.values() if trained.get(name, True)}
        for name, value in expected.items():
            if NAMES[name] in result.metrics:
                assert result.metrics[NAMES[name]].item() == pytest.approx(value, rel=2e-3, abs=1e-4), (turn, name)
        np.testing.assert_allclose(result.priorities, priorities, rtol=2e-3)
    for (name, value), other in zip(network.named_parameters(), plain.agent.parameters(), strict=True):
        torch.testing.assert_close(value, other, atol=3e-4, rtol=2e-3, msg=lambda text, name=name: f"{name}: {text}")
