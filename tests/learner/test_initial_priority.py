"""What an actor thinks a window is worth is what the learner would, with the same networks and noise."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig, HeadInput
from rmc.common.errors import MessageError
from rmc.common.window import WindowSpec
from rmc.learner.config import UpdateConfig
from rmc.learner.initial_priority import InitialPriority
from rmc.learner.update_order import make_update
from tests.hostile import hostile_state
from tests.learner.rows import BY_NUMBER, SPEC, random_rows, to_batch


@pytest.mark.parametrize("sizes", [SPEC, BY_NUMBER], ids=["by frame", "by number"])
@pytest.mark.parametrize("n_step", [1, 3])
@pytest.mark.parametrize("fill", [False, True])
@pytest.mark.parametrize("head_input", ["hidden", "hidden+observation"])
def test_it_is_the_learners_own_priority(n_step: int, head_input: HeadInput, fill: bool, sizes: WindowSpec) -> None:
    config = AgentConfig(
        hidden=SPEC.state, embedding=7, heads=(10, 9), head_input=head_input, normalize_observations=True,
        initial_priority="actor", impute_missing=fill,
    )  # fmt: skip
    torch.manual_seed(0)
    agent = Agent(SPEC.obs_dim, SPEC.action_dim, config, sizes.missing, sizes.privileged)
    total = torch.ones(sizes.statistics)
    agent.freeze_statistics(torch.tensor([10]), total, 20.0 * total)
    with torch.no_grad():
        agent.log_alpha.fill_(-1.0)
    update = UpdateConfig(n_step=n_step, gamma=0.9, eta=0.6)
    spec = dataclasses.replace(sizes, state=config.state_size(SPEC.obs_dim))
    priority_fn = InitialPriority(spec, config, update)
    priority_fn.reseed(3)
    priority_fn.load(safetensors.torch.save(agent.broadcast_weights()))
    rows = random_rows(6, spec=spec)
    learner = make_update(agent, update, seed=3)
    expected = learner.forward(to_batch(rows, spec), torch.zeros(()))[2].priorities
    np.testing.assert_allclose(priority_fn(rows), expected, rtol=1e-5)


def test_critics_are_broadcast_only_where_they_are_needed() -> None:
    names = [
        set(Agent(3, 2, AgentConfig(hidden=4, heads=(5, 5), initial_priority=kind)).broadcast_weights())
        for kind in ("max", "actor")
    ]
    assert not any(name.startswith("critic.") for name in names[0])
    assert {"log_alpha"} | {name for name in names[1] if name.startswith("critic.")} == names[1] - names[0]


SPOILT = {
    "no critics": lambda weights: {name: value for name, value in weights.items() if "critic" not in name},
    "no policy": lambda weights: {name: value for name, value in weights.items() if "policy" not in name},
    "another's": lambda weights: weights | {"other": torch.zeros(1)},
    "another shape": lambda weights: weights | {"log_alpha": torch.zeros(2)},
    "another type": lambda weights: weights | {"log_alpha": torch.zeros((), dtype=torch.float64)},
    "not finite": lambda weights: weights | {"log_alpha": torch.tensor(float("nan"))},
}


@pytest.mark.parametrize("spoilt", SPOILT.values(), ids=SPOILT)
def test_refused_weights_change_nothing(spoilt: Callable[[dict[str, torch.Tensor]], dict[str, torch.Tensor]]) -> None:
    config = AgentConfig(hidden=SPEC.state, heads=(5, 5), initial_priority="actor")
    torch.manual_seed(0)
    first, second = (Agent(SPEC.obs_dim, SPEC.action_dim, config).broadcast_weights() for _ in range(2))
    priority_fn, rows = InitialPriority(SPEC, config, UpdateConfig()), random_rows(6)
    priority_fn.load(safetensors.torch.save(first))
    priority_fn.reseed(3)
    before = priority_fn(rows)
    with pytest.raises(MessageError, match=r"^weights"):
        priority_fn.load(safetensors.torch.save(spoilt(second)))
    priority_fn.reseed(3)
    np.testing.assert_array_equal(priority_fn(rows), before)


def test_weights_never_execute_code(tmp_path: Path) -> None:
    priority_fn = InitialPriority(SPEC, AgentConfig(hidden=SPEC.state, heads=(5, 5)), UpdateConfig())
    with pytest.raises(MessageError, match="not of this run"):
        priority_fn.load(hostile_state(tmp_path / "owned"))
    assert not (tmp_path / "owned").exists()
