"""Adam and Polyak's average in one pass: the same numbers as torch's, and weights rounded on the way."""

import copy

import pytest
import torch
from torch import nn

from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.learner.config import UpdateConfig
from rmc.learner.fused import FusedHead, Rounded, fuse, rounded_weights
from rmc.learner.kernels import BLOCK
from rmc.learner.optimizers import CompiledAdam, adam, follow

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


def test_its_state_is_torchs():
    before, after = parameters(), parameters()
    compiled, plain = CompiledAdam([{"params": before}], {}), torch.optim.Adam([{"params": after}], fused=True)
    give_gradients(before, 1)
    compiled.step()
    plain.load_state_dict(compiled.state_dict())
    back = CompiledAdam([{"params": before}], {})
    back.load_state_dict(plain.state_dict())
    for value in before:
        assert all(torch.equal(back.state[value][name], compiled.state[value][name]) for name in back.state[value])


def test_a_nan_reaches_the_weight_and_no_other():
    values = parameters()
    optimizer = CompiledAdam([{"params": values}], {})
    give_gradients(values, 1)
    values[2].grad[3, 2] = float("nan")
    optimizer.step()
    assert [int(value.isnan().sum()) for value in values] == [0, 0, 1, 0]


@pytest.mark.parametrize("part", ["memory", "world_model", "next_frame", "critic", "policy"])
def test_weights_are_rounded_by_the_step(part):
    optimizer, module = adam(network := agent(), UpdateConfig(), part), getattr(network, part)
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
    follow(target, source, 0.01)
    for value, wanted in zip(target.parameters(), expected, strict=True):
        assert torch.allclose(value, wanted, rtol=1e-6, atol=1e-7)
    assert all(torch.equal(low, weight.to(torch.bfloat16)) for weight, low in rounded_weights([target]).items())
