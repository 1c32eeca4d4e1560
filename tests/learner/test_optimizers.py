"""Adam and Polyak's average in one pass: the same numbers as torch's, and weights rounded on the way."""

import copy

import pytest
import torch
from torch import nn

from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.learner.bfloat16.fused import fuse
from rmc.learner.bfloat16.fused_heads import FusedHead
from rmc.learner.bfloat16.kernels import BLOCK
from rmc.learner.bfloat16.rounded import Rounded, rounded_weights
from rmc.learner.config import UpdateConfig
from rmc.learner.optimizers import CompiledAdam, begin_moments, make_adam, polyak_update
from rmc.learner.update_order import make_update
from tests.learner.rows import SPEC, random_rows, to_batch

SHAPES = ((), (3,), (7, 5), (2, 41, 60))
RATES = {"lr": 3e-3, "betas": (0.8, 0.99), "eps": 1e-6}


def parameters() -> list[nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    return [nn.Parameter(torch.randn(shape, generator=generator)) for shape in SHAPES]


def give_gradients(values: list[nn.Parameter], step: int) -> None:
    """As of some losses; the last parameter has none at every third step."""
    generator = torch.Generator().manual_seed(step)
    for value in values:
        value.grad = torch.randn(value.shape, generator=generator) * 10.0 ** (step % 5 - 3)
    if step % 3 == 0:
        values[-1].grad = None


def agent() -> Agent:
    torch.manual_seed(0)
    network = Agent(3, 2, AgentConfig(hidden=24, embedding=20, heads=(40, 28), impute_missing=True))
    fuse(network)
    return network


def test_it_is_torchs_adam():
    assert max(value.numel() for value in parameters()) > 4 * BLOCK
    ours, theirs = parameters(), parameters()
    compiled = CompiledAdam([{"params": ours, **RATES}], {})
    plain = torch.optim.Adam([{"params": theirs, **RATES}], foreach=False)
    for step in range(40):
        for values, optimizer in ((ours, compiled), (theirs, plain)):
            give_gradients(values, step)
            optimizer.step()
    for value, expected in zip(ours, theirs, strict=True):
        assert torch.allclose(value, expected, rtol=1e-5, atol=1e-6)
        mine, other = compiled.state[value], plain.state[expected]
        assert mine["step"] == other["step"]
        assert torch.allclose(mine["exp_avg"], other["exp_avg"], rtol=1e-5, atol=1e-7)
        assert torch.allclose(mine["exp_avg_sq"], other["exp_avg_sq"], rtol=1e-5, atol=1e-9)
    assert compiled.state[ours[-1]]["step"] == 26


def test_either_goes_on_from_the_others_state():
    ours, theirs = parameters(), parameters()
    compiled, plain = CompiledAdam([{"params": ours}], {}), torch.optim.Adam([{"params": theirs}], fused=True)
    for step in range(1, 9):
        before, after = copy.deepcopy(compiled.state_dict()), copy.deepcopy(plain.state_dict())
        if step > 1:
            compiled.load_state_dict(after)
            plain.load_state_dict(before)
        for values, optimizer in ((ours, compiled), (theirs, plain)):
            give_gradients(values, step)
            optimizer.step()
    for value, expected in zip(ours, theirs, strict=True):
        assert torch.allclose(value, expected, rtol=1e-5, atol=1e-6)
        assert compiled.state[value]["step"] == plain.state[expected]["step"] > 4


def test_moments_of_another_size_are_not_read():
    values = parameters()
    optimizer = CompiledAdam([{"params": values}], {})
    give_gradients(values, 1)
    begin_moments(optimizer, values)
    optimizer.state[values[2]]["exp_avg"] = torch.zeros(3)
    with pytest.raises(AssertionError):
        optimizer.step()


@pytest.mark.parametrize("order", ["joint", "alternate"])
def test_after_updates_every_copy_is_its_weight_rounded(order):
    """Targets included, and amid a load."""
    config = UpdateConfig(update_order=order, target_memory="ema")
    network = AgentConfig(hidden=SPEC.state, embedding=8, heads=(16, 12))
    update = make_update(Agent(SPEC.obs_dim, SPEC.action_dim, network), config, 0, bf16=True)
    modules, batch = (update.agent, update.target_critic, update.ema_memory), to_batch(random_rows(8))
    begin = copy.deepcopy(update.state_dict())
    for number in range(4):
        if number == 2:
            update.load_state_dict(begin)
        update(batch, torch.tensor(0.1))
        copies = rounded_weights(modules)
        assert len(copies) == 13
        assert all(torch.equal(low, weight.bfloat16()) for weight, low in copies.items())


def test_a_nan_reaches_the_weight_and_no_other():
    values = parameters()
    optimizer = CompiledAdam([{"params": values}], {})
    give_gradients(values, 1)
    values[2].grad[3, 2] = float("nan")
    optimizer.step()
    assert [int(value.isnan().sum()) for value in values] == [0, 0, 1, 0]


@pytest.mark.parametrize("part", ["memory", "world_model", "next_frame", "critic", "policy"])
def test_weights_are_rounded_by_the_step(part):
    optimizer, module = make_adam(network := agent(), UpdateConfig(), part), getattr(network, part)
    weights = rounded_weights([module])
    assert len(weights) == (3 if part in ("world_model", "next_frame") else 2)
    for _ in range(3):
        for value in module.parameters():
            value.grad = torch.randn_like(value)
        optimizer.step()
        assert all(torch.equal(low, weight.to(torch.bfloat16)) for weight, low in weights.items())
        assert {weight: low.data_ptr() for weight, low in rounded_weights([module]).items()} == {
            weight: low.data_ptr() for weight, low in weights.items()
        }


def test_weights_that_were_written_are_rounded_before_they_are_read():
    head = agent().policy.net
    assert isinstance(head, FusedHead)
    x = torch.randn(5, 24)

    def out() -> torch.Tensor:
        with torch.autocast("cpu", torch.bfloat16), torch.no_grad():
            return head(x)

    before, state = out(), copy.deepcopy(head.state_dict())
    with torch.no_grad():
        head[0].weight.add_(1.0)
    assert not torch.equal(out(), before)
    head.load_state_dict(state)
    assert torch.equal(out(), before)


def test_a_target_follows_as_by_torch_and_is_rounded():
    source, target = agent().critic, agent().critic
    assert isinstance(target, Rounded)
    with torch.no_grad():
        for value in source.parameters():
            value.add_(torch.randn_like(value))
    expected = [old.lerp(new, 0.01) for old, new in zip(target.parameters(), source.parameters(), strict=True)]
    polyak_update(target, source, 0.01)
    for value, wanted in zip(target.parameters(), expected, strict=True):
        assert torch.allclose(value, wanted, rtol=1e-6, atol=1e-7)
    assert all(torch.equal(low, weight.to(torch.bfloat16)) for weight, low in rounded_weights([target]).items())
