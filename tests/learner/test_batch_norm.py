"""Batch norm in the critics: its numbers beside torch's, padding, running statistics, the fused way."""

import copy
from collections import Counter

import pytest
import torch
from torch import Tensor

from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.common.critic import MOMENTUM, VARIANCE_EPS, BatchNorm, TwinQ
from rmc.learner.bfloat16.fused import fuse
from rmc.learner.config import UpdateConfig
from rmc.learner.update_order import make_update
from tests.learner.agents import distance
from tests.learner.rows import SPEC, random_rows, to_batch

B, T, Z, A = 16, 15, 24, 2
CONFIG = AgentConfig(hidden=Z, embedding=20, heads=(80, 60), critic_batch_norm=True)


def inputs() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features, actions, mask, and by how much each Q counts."""
    generator = torch.Generator().manual_seed(1)
    mask = (torch.rand(B, T, generator=generator) < 0.7).float()
    weight = torch.randn(2, B, T, generator=generator) * mask
    features = torch.randn(B, T, Z, generator=generator).bfloat16().float()  # as the update hands them over
    return features, torch.randn(B, T, A, generator=generator), mask, weight


def agent(seed: int = 0) -> Agent:
    """Some updates old: its running statistics have moved."""
    torch.manual_seed(seed)
    made = Agent(3, A, CONFIG)
    features, action, mask, _ = inputs()
    with torch.no_grad():
        for norm in made.critic.norms[1:]:
            norm.gain.uniform_(0.5, 1.5)
            norm.offset.uniform_(-0.5, 0.5)
        for _ in range(200):
            made.critic(3.0 * features + 1.0, action, mask)
    return made


def values_and_gradients(made: Agent, given: bool, low: bool) -> dict[str, Tensor]:
    features, action, mask, weight = inputs()
    features.requires_grad_()
    action.requires_grad_()
    made.zero_grad()
    with torch.autocast("cpu", torch.bfloat16, enabled=low):
        q = made.critic(features, action, mask if given else None)
    (q * weight).sum().backward()
    named = {name: value.grad for name, value in made.critic.named_parameters() if value.grad is not None}
    return {"q": (q * mask).detach(), "features": features.grad, "action": action.grad} | named  # type: ignore[dict-item]


def test_where_all_rows_are_real_it_is_torchs_batch_norm() -> None:
    x = torch.randn(1, 30, 4).mul(3.0).add(1.0).requires_grad_()
    ours, theirs = (
        BatchNorm(1, 4, affine=False),
        torch.nn.BatchNorm1d(4, eps=VARIANCE_EPS, momentum=MOMENTUM, affine=False),
    )
    expected, actual = theirs(x[0]), ours(x, torch.full((30,), 1 / 30))
    torch.testing.assert_close(actual[0], expected)
    grads = [torch.autograd.grad((out * torch.arange(4.0)).square().sum(), x)[0] for out in (expected, actual[0])]
    torch.testing.assert_close(*grads)
    assert theirs.running_mean is not None
    torch.testing.assert_close(ours.mean[0, 0], theirs.running_mean)
    theirs.running_var = ours.variance[0, 0]  # torch's has N - 1 there
    torch.testing.assert_close(ours(x)[0], theirs.eval()(x[0]))


@pytest.mark.parametrize("low", [False, True])
def test_what_is_not_real_counts_for_nothing(low: bool) -> None:
    features, action, mask, _ = inputs()
    for made in (agent(), agent()):
        if low:
            fuse(made)
        spoilt = copy.deepcopy(made)
        other = torch.where(mask.bool().unsqueeze(-1), features, 1e3)
        with torch.autocast("cpu", torch.bfloat16, enabled=low):
            expected, actual = made.critic(features, action, mask), spoilt.critic(other, action, mask)
        assert torch.equal(expected * mask, actual * mask)
        assert all(map(torch.equal, made.state_dict().values(), spoilt.state_dict().values()))


@pytest.mark.parametrize("low", [False, True])
def test_running_statistics_move_with_the_critics_own_pass_alone(low: bool) -> None:
    made, (features, action, mask, _) = agent(), inputs()
    if low:
        fuse(made)
    running = dict(made.critic.norms.named_buffers())
    before = copy.deepcopy(running)
    with torch.autocast("cpu", torch.bfloat16, enabled=low):
        made.critic(features, action)
        assert all(torch.equal(value, before[name]) for name, value in running.items())
        made.critic(features, action, mask)
    assert not any(torch.equal(value, before[name]) for name, value in running.items())


@pytest.mark.parametrize("given", [True, False], ids=["these steps'", "running"])
def test_the_fused_way_is_as_near_to_float32_as_plain_bfloat16(given: bool) -> None:
    far, plain = Counter[str](), Counter[str]()  # over several agents: in one, few ReLUs decide
    for seed in range(4):
        exact = agent(seed)
        usual, actual = copy.deepcopy(exact), copy.deepcopy(exact)
        fuse(actual)
        expected = values_and_gradients(exact, given, low=False)
        far.update(distance(values_and_gradients(actual, given, low=True), expected))
        plain.update(distance(values_and_gradients(usual, given, low=True), expected))
        for ours, theirs in zip(actual.critic.norms.buffers(), exact.critic.norms.buffers(), strict=True):
            torch.testing.assert_close(ours, theirs, atol=2e-3, rtol=2e-2)
    assert all(value < 1.5 * plain[name] + 2e-2 for name, value in far.items()), (far, plain)
    assert max(far.values()) > 1e-5  # it is bfloat16


@pytest.mark.parametrize("normed", [True, False])
def test_normalised_critics_begin_with_as_much_of_the_action_as_of_the_state(normed: bool) -> None:
    torch.manual_seed(0)
    critic = TwinQ(256, 8, AgentConfig(critic_batch_norm=normed))
    state, action = torch.randn(2_000, 256), torch.randn(2_000, 8)
    with torch.no_grad():
        weight = critic.layers[0].weight
        of_state, of_action = (
            float((x @ part).std()) for x, part in ((state, weight[:, :256]), (action, weight[:, 256:]))
        )
    assert of_action / of_state == pytest.approx(1.0 if normed else (8 / 256) ** 0.5, rel=0.1)


def test_a_batch_without_a_real_step_leaves_numbers() -> None:
    for low in (False, True):
        made, (features, action, mask, _) = agent(), inputs()
        if low:
            fuse(made)
        with torch.autocast("cpu", torch.bfloat16, enabled=low):
            assert made.critic(features, action, 0.0 * mask).isfinite().all()


def test_an_update_has_no_targets_and_its_checkpoint_brings_the_statistics_back() -> None:
    updates = []
    for _ in range(2):
        torch.manual_seed(0)
        config = AgentConfig(hidden=SPEC.state, embedding=8, heads=(16, 12), critic_batch_norm=True)
        updates.append(make_update(Agent(SPEC.obs_dim, SPEC.action_dim, config), UpdateConfig(), 0))
    first, second = updates
    assert first.target_critic is None
    for turn in range(3):
        first(to_batch(random_rows(4, turn)), torch.zeros(()))
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    assert first.agent.critic.norms[0].mean.abs().max() > 0
    for update in updates:
        update(to_batch(random_rows(4, 9)), torch.zeros(()))
    assert all(map(torch.equal, first.agent.state_dict().values(), second.agent.state_dict().values()))
