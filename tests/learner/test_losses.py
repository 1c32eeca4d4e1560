"""Every loss against a slow, plain reference: loops over batch and time, written from the equations."""

import math

import numpy as np
import pytest
import torch

from rmc.common.agent import squashed_sample
from rmc.learner import losses

B, T, H, OBS, A = 4, 5, 6, 3, 2


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def m() -> np.ndarray:
    mask = np.ones((B, T), np.float32)
    mask[0, 3:], mask[2, 1:] = 0.0, 0.0
    return mask


@pytest.fixture
def d() -> np.ndarray:
    ends = np.zeros((B, T), np.float32)
    ends[0, 2], ends[3, 4] = 1.0, 1.0
    return ends


def tensors(*arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.as_tensor(np.asarray(array, np.float32)) for array in arrays]


def real_steps(m: np.ndarray) -> list[tuple[int, int]]:
    return [(b, t) for b in range(B) for t in range(T) if m[b, t]]


@pytest.mark.parametrize("norm", ["l1", "l2"])
def test_model_error_and_loss(rng, m, d, norm):
    f, change = rng.normal(size=(2, B, T, H))
    expected, count = 0.0, 0
    for b, t in real_steps(m):
        if not d[b, t]:
            differences = [f[b, t, u] - change[b, t, u] for u in range(H)]
            mean = sum(abs(x) for x in differences) / H
            expected += mean if norm == "l1" else math.sqrt(sum(x * x for x in differences) / H)
            count += 1
    ft, ct, mt, dt = tensors(f, change, m, d)
    loss = losses.model_loss(losses.model_error(ft, ct, norm), dt, mt)
    assert loss.item() == pytest.approx(expected / count, rel=1e-5)


@pytest.mark.parametrize("norm", ["l1", "l2"])
def test_model_target_gets_no_gradient(norm):
    f, change = (torch.randn(B, T, H, requires_grad=True) for _ in range(2))
    losses.model_error(f, change, norm).sum().backward()
    assert f.grad is not None
    assert change.grad is None


def test_a_perfect_l2_prediction_has_a_finite_gradient():
    f = torch.zeros(B, T, H, requires_grad=True)
    losses.model_error(f, torch.zeros(B, T, H), "l2").sum().backward()
    assert f.grad is not None
    assert f.grad.isfinite().all()


def test_curiosity_is_the_error_without_gradient(rng, m, d):
    error = torch.rand(B, T, requires_grad=True)
    i = losses.curiosity(error, *tensors(d, m))
    for b in range(B):
        for t in range(T):
            wanted = error[b, t].item() if m[b, t] and not d[b, t] else 0.0
            assert i[b, t].item() == pytest.approx(wanted)
    assert not i.requires_grad


def test_soft_value(rng):
    q, log_pi, alpha = rng.normal(size=(2, B, T)), rng.normal(size=(B, T)), 0.3
    qt, lt = tensors(q, log_pi)
    torch.testing.assert_close(
        losses.soft_value(qt, torch.tensor(alpha), lt), tensors(np.minimum(q[0], q[1]) - alpha * log_pi)[0]
    )


@pytest.mark.parametrize("n", [1, 2, 3, 5, 99])
def test_td_target(rng, m, d, n):
    """Rewards of up to n steps, then the value; the sum stops at a termination and at the last real step."""
    reward, value = rng.normal(size=(2, B, T))
    gamma = 0.97
    rt, dt, vt, mt = tensors(reward, d, value, m)
    y = losses.td_target(rt, gamma, dt, vt, mt, n)
    for b, t in real_steps(m):
        wanted, k = 0.0, t
        while True:
            wanted += gamma ** (k - t) * reward[b, k]
            if d[b, k]:
                break
            if k - t + 1 == n or k + 1 == T or not m[b, k + 1]:
                wanted += gamma ** (k - t + 1) * value[b, k]  # value[b, k] is that of the state after step k
                break
            k += 1
        assert y[b, t].item() == pytest.approx(wanted, rel=1e-5, abs=1e-6)


def test_a_target_has_no_gradient():
    reward, value = (torch.randn(B, T, requires_grad=True) for _ in range(2))
    assert not losses.td_target(reward, 0.9, torch.zeros(B, T), value, torch.ones(B, T), 3).requires_grad


def test_q_loss(rng, m):
    q, y, w = rng.normal(size=(2, B, T)), rng.normal(size=(B, T)), rng.uniform(0.1, 1.0, size=B)
    steps = real_steps(m)
    expected = sum(w[b] * 0.5 * sum((q[j, b, t] - y[b, t]) ** 2 for j in (0, 1)) for b, t in steps) / len(steps)
    assert losses.q_loss(*tensors(q, y, w, m)).item() == pytest.approx(expected, rel=1e-5)


def test_policy_and_temperature_loss(rng, m):
    log_pi, q = rng.normal(size=(2, B, T))
    alpha, target = 0.4, -2.0
    steps = real_steps(m)
    policy = sum(alpha * log_pi[b, t] - q[b, t] for b, t in steps) / len(steps)
    temperature = -math.log(alpha) * sum(log_pi[b, t] + target for b, t in steps) / len(steps)
    lt, qt, mt = tensors(log_pi, q, m)
    log_alpha = torch.tensor(math.log(alpha))
    assert losses.policy_loss(lt, qt, log_alpha.exp(), mt).item() == pytest.approx(policy, rel=1e-5)
    assert losses.temperature_loss(log_alpha, lt, target, mt).item() == pytest.approx(temperature, rel=1e-5)


def test_temperature_rises_when_entropy_is_too_low():
    log_alpha = torch.zeros((), requires_grad=True)
    too_sure = torch.full((1, 1), 5.0)  # log pi far above -target: entropy below the target
    losses.temperature_loss(log_alpha, too_sure, -2.0, torch.ones(1, 1)).backward()
    assert log_alpha.grad is not None
    assert log_alpha.grad < 0.0


@pytest.mark.parametrize("flags", [1, OBS])
def test_grounding_loss(rng, m, flags):
    f, change = rng.normal(size=(2, B, T, OBS))
    fr, r = rng.normal(size=(2, B, T))
    seen = (rng.uniform(size=(B, T, flags)) < 0.6).astype(np.float32)
    parts = [slice(None)] if flags == 1 else list(range(OBS))  # what each flag speaks of
    errors = [
        np.abs(f[b, t] - change[b, t])[part].mean()
        for b, t in real_steps(m)
        for flag, part in enumerate(parts)
        if seen[b, t, flag]
    ]
    o_part = np.mean(errors)
    r_part = sum(abs(fr[b, t] - r[b, t]) for b, t in real_steps(m)) / len(real_steps(m))
    loss = losses.grounding_loss(*tensors(f, change, fr, r, seen, m)).item()
    assert loss == pytest.approx(o_part + r_part, rel=1e-5)


def test_priority(rng, m):
    size = abs(rng.normal(size=(B, T)))
    priorities = losses.priority(*tensors(size), 0.9, *tensors(m))
    for b in range(B):
        sizes = [size[b, t] for t in range(T) if m[b, t]]
        assert priorities[b].item() == pytest.approx(0.9 * max(sizes) + 0.1 * sum(sizes) / len(sizes), rel=1e-5)


def test_masked_mean_of_nothing_is_zero():
    assert losses.masked_mean(torch.ones(2, 3), torch.zeros(2, 3)).item() == 0.0


def test_squashed_log_density_against_change_of_variables(rng):
    mean, log_std, noise = tensors(*rng.normal(size=(3, 50, A)) * 0.8)
    action, log_pi = squashed_sample(mean, log_std, noise)
    normal = torch.distributions.Normal(mean.double(), log_std.double().exp())
    u = torch.atanh(action.double())
    plain = (normal.log_prob(u) - torch.log(1.0 - action.double() ** 2)).sum(-1)
    torch.testing.assert_close(log_pi.double(), plain, rtol=1e-4, atol=1e-4)


def test_squashed_log_density_is_finite_where_tanh_saturates():
    _, log_pi = squashed_sample(torch.full((1, 1), 40.0), torch.zeros(1, 1), torch.zeros(1, 1))
    assert torch.isfinite(log_pi).all()


def test_a_temperature_trains_nothing_but_itself():
    """Where alpha is 1, as at the start, log alpha is 0 and so is any other gradient: it is not, here."""
    log_alpha, log_pi = torch.tensor(-2.0, requires_grad=True), torch.randn(B, T, requires_grad=True)
    losses.temperature_loss(log_alpha, log_pi, -1.0, torch.ones(B, T)).backward()
    assert log_alpha.grad is not None
    assert log_pi.grad is None
