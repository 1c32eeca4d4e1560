"""What critics alone read reaches nothing that remembers, predicts, acts, is exported or evaluated."""

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from rmc.common.agent import Agent
from rmc.common.agent_config import CRITIC_PARTS, AgentConfig
from rmc.learner.config import UpdateConfig
from rmc.learner.update import MODEL_PARTS, JointUpdate
from rmc.learner.update_order import make_update
from tests.learner.rows import BY_NUMBER, random_rows, to_batch

CONFIG = AgentConfig(
    hidden=8, embedding=7, heads=(10, 9), normalize_observations=True, missing_flag=True, impute_missing=True,
    privileged_critic=True,
)  # fmt: skip
SPEC = dataclasses.replace(BY_NUMBER, state=CONFIG.state_size(BY_NUMBER.obs_dim))


def make(privileged: int = SPEC.privileged, bf16: bool = False, **options: object) -> JointUpdate:
    torch.manual_seed(0)
    agent = Agent(SPEC.obs_dim, SPEC.action_dim, CONFIG, SPEC.missing, privileged)
    return make_update(agent, UpdateConfig(curiosity=0.5, **options), 3, bf16)  # type: ignore[arg-type]


def rows_with(privileged: float) -> np.ndarray:
    rows = random_rows(8, spec=SPEC)
    rows["privileged"] *= privileged
    return rows


@pytest.mark.parametrize("scheme", [1, 2, 3, 4, 5, 6])
def test_no_gradient_of_an_output_leads_to_it_but_of_the_critics(scheme: int) -> None:
    """Neither of the model's losses and states, nor of what the policy says; of both critics and their loss."""
    update = make(scheme=scheme)
    batch = to_batch(rows_with(1.0), SPEC)
    batch = dataclasses.replace(batch, privileged=batch.privileged.clone().requires_grad_())
    model_losses, model = update.model_pass(batch)
    mean, log_std = update.agent.policy(model.z)
    blind = [*model_losses.values(), model.z, model.hidden, model.curiosity, mean, log_std]
    actor_critic_losses = update.actor_critic_pass(batch, model, torch.tensor(0.5))[0]
    outputs = {"blind": blind, "seeing": [actor_critic_losses["q_loss"], actor_critic_losses["policy_loss"]]}
    reached = {name: [reaches(output, batch.privileged) for output in some] for name, some in outputs.items()}
    assert reached == {"blind": [False] * len(blind), "seeing": [True, True]}


def reaches(output: Tensor, source: Tensor) -> bool:
    if not output.requires_grad:
        return False
    (gradient,) = torch.autograd.grad(output.sum(), source, retain_graph=True, allow_unused=True)
    return gradient is not None and bool(gradient.any())


@pytest.mark.parametrize("bf16", [False, True])
def test_its_values_change_the_critics_and_no_weight_that_remembers_or_predicts(bf16: bool) -> None:
    """Bit for bit, over some updates of scheme 3, in which nothing flows back from critics."""
    updates = [make(scheme=3, bf16=bf16) for _ in range(2)]
    for update, size in zip(updates, (1.0, 100.0), strict=True):
        for _ in range(3):
            update(to_batch(rows_with(size), SPEC), torch.tensor(0.5))
    one, other = (update.agent.state_dict() for update in updates)
    same = {name for name in one if torch.equal(one[name], other[name])}
    assert {name for name in one if name.startswith((*MODEL_PARTS, "normalizer."))} <= same
    assert not {name for name in one if name.startswith("critic.")} & same


def test_what_acts_is_as_without_it() -> None:
    """The same weights are sent, saved and averaged; what is sent to actors that rate windows also has the critics."""
    seeing, blind = make().agent, make(privileged=0).agent
    assert seeing.policy_shapes() == blind.policy_shapes()
    assert seeing.acting().keys() == blind.acting().keys()
    assert not [name for name in seeing.policy_weights() if name.startswith(CRITIC_PARTS)]
    seeing.config = dataclasses.replace(CONFIG, initial_priority="actor")
    sent = seeing.broadcast_weights().keys() - seeing.policy_weights().keys()
    assert {name.partition(".")[0] for name in sent} == {"critic", "log_alpha", "privileged_normalizer"}


def test_it_is_normalised_by_its_own_statistics_and_what_is_seldom_seen_by_its_own() -> None:
    agent = make().agent
    count = torch.tensor([1, 10, 20, 30, 30])
    mean, std = torch.tensor([9.0, 1.0, 2.0, 3.0, -4.0]), torch.tensor([9.0, 0.5, 1.0, 2.0, 3.0])
    agent.freeze_statistics(count, (mean * count).double(), ((std**2 + mean**2) * count).double())
    torch.testing.assert_close(agent.normalizer.mean, torch.tensor([0.0, 1.0, 2.0]))  # of one number there is none yet
    torch.testing.assert_close(agent.normalizer.std, torch.tensor([1.0, 0.5, 1.0]))
    torch.testing.assert_close(agent.normalized_privileged(torch.tensor([5.0, -100.0])), torch.tensor([1.0, -10.0]))
