"""The fused networks against the plain ones they take the place of: values, gradients, names, NaN."""

import copy
import dataclasses
from statistics import median

import numba
import numpy as np
import pytest
import torch

from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.learner.bfloat16 import kernels
from rmc.learner.bfloat16.fused import FusedGRU, fuse
from rmc.learner.bfloat16.fused_heads import FusedHead, FusedTwinQ
from rmc.learner.config import UpdateConfig
from rmc.learner.update_order import make_update
from tests.learner.agents import distance
from tests.learner.rows import SPEC, random_rows, to_batch

B, T = 6, 5
CONFIG = AgentConfig(hidden=24, embedding=20, heads=(40, 28), head_input="hidden+observation", impute_missing=True)


def floats(bits):
    return (bits.astype(np.uint32) << 16).view(np.float32)


def bits(values):
    return torch.tensor(values, dtype=torch.bfloat16).view(torch.uint16).numpy()


@pytest.fixture
def pair():
    return make_pair(0)


def make_pair(seed):
    torch.manual_seed(seed)
    plain = Agent(3, 2, CONFIG)
    fused = copy.deepcopy(plain)
    fuse(fused)
    return plain, fused


def run_gru(agent, low, x, hidden):
    with torch.autocast("cpu", torch.bfloat16, enabled=low):
        return agent.memory.gru(x, hidden)[0]


def run_critic(agent, low, x, action):
    with torch.autocast("cpu", torch.bfloat16, enabled=low):
        return agent.critic(x, action)


def run_policy(agent, low, x):
    with torch.autocast("cpu", torch.bfloat16, enabled=low):
        return torch.cat(agent.policy(x), -1)


def run_next_frame(agent, low, x, o, action):
    with torch.autocast("cpu", torch.bfloat16, enabled=low):
        return agent.next_frame(x, o, action) - o


def run_model(agent, low, x, action):
    with torch.autocast("cpu", torch.bfloat16, enabled=low):
        output = agent.world_model(x, action)
        return torch.cat([output.hidden_change, output.observation_change, output.reward.unsqueeze(-1)], -1)


CASES = {
    "memory": (run_gru, [(B, T, 20), (1, B, 24)]),
    "critic": (run_critic, [(B, T, 27), (B, T, 2)]),
    "policy": (run_policy, [(B, T, 27)]),
    "world_model": (run_model, [(B, T, 27), (B, T, 2)]),
    "next_frame": (run_next_frame, [(B, T, 24), (B, T, 3), (B, T, 2)]),
}


def everything(agent, part, low):
    """Output, gradients of the inputs and of the part's parameters."""
    run, shapes = CASES[part]
    generator = torch.Generator().manual_seed(1)
    inputs = [torch.randn(shape, generator=generator).requires_grad_() for shape in shapes]
    out = run(agent, low, *inputs).float()
    weight = torch.randn(out.shape, generator=generator)
    agent.zero_grad()
    (out * weight).sum().backward()
    module = getattr(agent, part)
    named = {name: p.grad for name, p in module.named_parameters() if p.grad is not None}
    return {"out": out.detach(), **{f"input {k}": x.grad for k, x in enumerate(inputs)}, **named}


@pytest.mark.parametrize("part", CASES)
def test_values_and_gradients_are_about_as_near_to_float32_as_plain_bfloat16(part):
    """Of most agents: a unit near 0 that rounding switches on or off makes one gradient differ by percents."""
    actual, usual = {}, {}
    for seed in range(15):
        plain, fused = make_pair(seed)
        exact = everything(plain, part, low=False)
        for agent, distances in ((fused, actual), (plain, usual)):
            for name, far in distance(everything(agent, part, low=True), exact).items():
                distances.setdefault(name, []).append(far)
    assert len(actual) > 4
    for name, far in actual.items():
        assert median(far) < 2.0 * median(usual[name]) + 2e-3, (name, far, usual[name])
    assert max(map(max, actual.values())) > 1e-5  # it is bfloat16


def test_one_observation_number_is_imputed_as_several_are():
    torch.manual_seed(0)
    plain = Agent(1, 2, CONFIG)
    fused = copy.deepcopy(plain)
    fuse(fused)
    hidden, o, action = torch.randn(B, T, 24), torch.randn(B, T, 1), torch.randn(B, T, 2)
    outputs = []
    for agent in (plain, fused):
        outputs.append(run_next_frame(agent, True, hidden, o, action))
        outputs[-1].sum().backward()
    torch.testing.assert_close(*outputs, atol=0.02, rtol=0.02)
    expected, actual = (agent.next_frame.net[0].weight.grad for agent in (plain, fused))
    assert float((actual - expected).norm() / expected.norm()) < 0.05


@pytest.mark.parametrize("part", CASES)
def test_without_autocast_they_are_the_plain_ones_to_the_bit(pair, part):
    plain, fused = pair
    expected, actual = everything(plain, part, low=False), everything(fused, part, low=False)
    assert all(torch.equal(actual[name], value) for name, value in expected.items())


@pytest.mark.parametrize("net", ["memory.embed", "world_model.net", "next_frame.net", "policy.net"])
def test_a_layer_that_the_fused_networks_do_not_know_is_an_error(net):
    changed = Agent(3, 2, CONFIG)
    changed.get_submodule(net)[1] = torch.nn.Tanh()
    with pytest.raises(AssertionError):
        fuse(changed)


def test_parameters_keep_their_names_and_values(pair):
    plain, fused = pair
    assert isinstance(fused.memory.gru, FusedGRU)
    assert isinstance(fused.policy.net, FusedHead)
    assert isinstance(fused.world_model.net, FusedHead)
    assert isinstance(fused.critic, FusedTwinQ)
    ours, theirs = fused.state_dict(), plain.state_dict()
    assert list(ours) == list(theirs)
    assert all(torch.equal(ours[name], value) for name, value in theirs.items())


FILLING = AgentConfig(hidden=24, embedding=20, heads=(40, 28), impute_missing=True)


def impute(config, low, scale=1.0, flags=1):
    """By a plain and a fused agent, and the observations and which of their numbers were missing."""
    torch.manual_seed(0)
    plain = Agent(3, 2, config, flags)
    with torch.no_grad():
        plain.next_frame.net[4].weight *= scale
    fused = copy.deepcopy(plain)
    fuse(fused)
    generator = torch.Generator().manual_seed(3)
    o, action, state = (torch.randn(shape, generator=generator) for shape in ((B, T, 3), (B, T, 2), (B, 27)))
    missing = torch.rand(B, T, flags, generator=generator) < 0.5
    o[missing.expand_as(o)] = 0.0
    with torch.autocast("cpu", torch.bfloat16, enabled=low):
        filled = [agent.impute(o, missing, action, state) for agent in (plain, fused)]
    return *filled, o, missing.expand_as(o)


@pytest.mark.parametrize("flags", [1, 3])
@pytest.mark.parametrize("flag", [False, True])
def test_blanks_are_filled_to_the_precision_of_bfloat16_and_nothing_else_is_touched(flag, flags):
    config = dataclasses.replace(FILLING, missing_flag=flag)
    (plain, plain_after), (fused, after), o, missing = impute(config, low=True, flags=flags)
    assert torch.equal(fused[~missing], o[~missing])
    gap = (fused - plain)[missing].norm() / plain[missing].norm()
    assert 1e-5 < gap < 0.01
    assert 1e-5 < (after - plain_after).norm() / plain_after.norm() < 0.01
    assert (plain - o)[missing].norm() > 0.1


def test_until_an_episodes_first_frame_is_seen_it_is_zeros():
    torch.manual_seed(0)
    plain = Agent(3, 2, FILLING)
    fused = copy.deepcopy(plain)
    fuse(fused)
    o, action, state = torch.zeros(2, 4, 3), torch.zeros(2, 4, 2), torch.zeros(2, 27)
    missing = torch.tensor([[True, True, False, True]] * 2).unsqueeze(-1)
    o[:, 2] = torch.tensor([0.5, 0.0, -1.0])
    with torch.autocast("cpu", torch.bfloat16):
        filled = [agent.impute(o, missing, action, state)[0] for agent in (plain, fused)]
    for seen in filled:
        assert not seen[:, :2].any()
        assert torch.equal(seen[:, 2], o[:, 2])
        assert (seen[:, 3] != 0).all()


def test_what_fills_a_blank_stays_where_observations_are():
    for output, _ in impute(FILLING, low=True, scale=1e6)[:2]:
        assert output.abs().max() == 10.0


@pytest.mark.parametrize("changed", [{"embedding": 0}, {"head_input": "observation"}, {}])
def test_where_the_fused_way_does_not_fit_blanks_are_filled_the_plain_way_to_the_bit(changed):
    plain, fused, o, missing = impute(dataclasses.replace(FILLING, **changed), low=bool(changed))
    assert all(map(torch.equal, plain, fused))
    assert not torch.equal(plain[0][missing], o[missing])


@pytest.mark.parametrize("asked", ["features", "action", "neither"])
def test_the_way_back_through_the_critics_gives_what_is_asked_for(pair, asked):
    plain, fused = pair
    generator = torch.Generator().manual_seed(2)
    features, action = torch.randn(B, T, 27, generator=generator), torch.randn(B, T, 2, generator=generator)
    grads = []
    for agent in (plain, fused):
        x, a = features.clone().requires_grad_(asked == "features"), action.clone().requires_grad_(asked == "action")
        agent.critic.requires_grad_(asked == "neither")
        run_critic(agent, agent is fused, x, a).sum().backward()
        grads.append((x.grad, a.grad, agent.critic.layers[0].weight.grad))
    for exact, actual in zip(*grads, strict=True):
        assert (exact is None) == (actual is None)
        if exact is not None:
            assert float((actual - exact).norm() / exact.norm()) < 0.1  # a ReLU near 0 may open or close by rounding


def test_an_update_in_bfloat16_is_fused_and_one_in_float32_is_not():
    for low in (True, False):
        agent = Agent(SPEC.obs_dim, SPEC.action_dim, AgentConfig(hidden=SPEC.state, embedding=8, heads=(16, 12)))
        update = make_update(agent, UpdateConfig(), 0, low)
        assert isinstance(agent.memory.gru, FusedGRU) == low
        assert isinstance(update.target_critic, FusedTwinQ) == low
        before = {name: value.clone() for name, value in agent.state_dict().items()}
        update(to_batch(random_rows(4)), torch.zeros(()))
        moved = {name for name, value in agent.state_dict().items() if not torch.equal(value, before[name])}
        assert {name for name, _ in agent.named_parameters()} <= moved


@pytest.mark.parametrize("part", CASES)
def test_a_nan_is_not_swallowed(pair, part):
    _, fused = pair
    run, shapes = CASES[part]
    for spoilt in range(len(shapes)):
        inputs = [torch.zeros(shape) for shape in shapes]
        inputs[spoilt].view(-1)[0] = float("nan")
        assert run(fused, True, *inputs).isnan().any()
    bias = next(p for name, p in getattr(fused, part).named_parameters() if "bias" in name and "embed" not in name)
    with torch.no_grad():
        bias.view(-1)[0] = float("nan")
    assert run(fused, True, *(torch.zeros(shape) for shape in shapes)).isnan().any()


def test_rounding_is_torchs_own():
    values = np.random.default_rng(0).normal(size=4096).astype(np.float32)
    x = np.concatenate([values, values * 1e30, values * 1e-30, [0.0, -0.0, 1.0, 1.00390625, np.inf, -np.inf]])
    x = x.astype(np.float32)
    out = np.zeros(len(x), np.uint16)
    kernels.lower(x, out)
    assert np.array_equal(out, torch.from_numpy(x).to(torch.bfloat16).view(torch.uint16).numpy())


def test_the_exponential_is_right_to_5e_7():
    @numba.njit
    def exponentials(x, out):
        for i in range(x.size):
            out[i] = kernels._exp(x[i])

    x = np.concatenate([np.linspace(-86.9, 86.9, 20_001), np.linspace(-1.0, 1.0, 5001)]).astype(np.float32)
    out = np.empty_like(x)
    exponentials(x, out)
    assert np.abs(out / np.exp(x.astype(np.float64)) - 1.0).max() < 5e-7


def test_gates_saturate_without_overflow():
    extreme = np.array([[-1e30, -100.0, 0.0, 100.0, 1e30, np.inf]], np.float32)
    h = np.full((1, 2), 0.5, np.float32)
    gi, kept = bits(extreme), np.zeros((1, 8), np.float32)
    new, low, none = np.zeros((1, 2), np.float32), np.zeros((1, 2), np.uint16), np.zeros(6, np.float32)
    kernels.gru_step(gi, bits(np.zeros((1, 6))), none, none, h, kept, new, low)
    # r of both units, z of both, n of both: saturated low, middle, high
    assert np.allclose(kept[0, :4], [0.0, 0.0, 0.5, 1.0], atol=1e-6)
    assert np.allclose(kept[0, 4:6], [1.0, 1.0])
    assert np.allclose(new, [[0.75, 0.5]])
    assert np.array_equal(floats(low), new)
