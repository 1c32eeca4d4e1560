"""The losses of RMC, one function per equation, and nothing else.

Shapes: B batch, T trained steps (L_t), O observation, A action, H hidden, M flags of what is missing: 1 or O.
All tensors float32.
Equations are numbered as in the paper; its s_t is h_t here.
Notation: h_t memory, a_t action, r_t reward, d_t true termination, m_t mask (1 = real trained step),
sg stop-gradient. Every loss is a masked mean, sum(m * x) / sum(m); what is minimised is their plain sum.
Source: arXiv 1908.11494, with the gaps settled in ``docs/algorithm.md``.
"""

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

NORM_EPS = 1e-12  # keeps the root's gradient finite at zero


def masked_mean(x: Tensor, m: Tensor) -> Tensor:
    """sum(m * x) / sum(m) over (B, T), or (B, T, M); 0 where nothing is real."""
    return (m * x).sum() / m.sum().clamp(min=1.0)


def model_error(predicted_change: Tensor, change: Tensor, norm: Literal["l1", "l2"]) -> Tensor:
    """Eq. 7: f(h_t, a_t) - sg(h_{t+1} - h_t), its mean size over H (L1) or root mean square (L2): (B, T, H) -> (B, T).

    The paper's text says L1 and compares it with the L2 that its equation prints.
    """
    difference = predicted_change - change.detach()
    if norm == "l1":
        return difference.abs().mean(-1)
    return (difference.square().mean(-1) + NORM_EPS).sqrt()


def model_loss(error: Tensor, d: Tensor, m: Tensor) -> Tensor:
    """Eq. 7: L_model: the error where the episode goes on, so (1 - d_t) is part of the mask.

    (After a termination h_{t+1} is there, too, but nothing is decided in it.)
    """
    return masked_mean(error, m * (1.0 - d))


def curiosity(error: Tensor, d: Tensor, m: Tensor) -> Tensor:
    """Eq. 8: i_t of R_t = r_t + beta i_t: the model's own error, without gradient, zero at terminations and padding.

    The sum is taken where ``td_target`` is called, with i_t scaled where configured.
    """
    return error.detach() * (1.0 - d) * m


def soft_value(target_q: Tensor, alpha: Tensor, log_pi: Tensor) -> Tensor:
    """Eq. 9: V(h) = min_j Qbar_j(h, a') - alpha log pi(a'|h), a' and log pi from one sample: (2, B, T) -> (B, T).

    With batch norm Qbar is Q.
    """
    return target_q.min(0).values - alpha * log_pi


def td_target(reward: Tensor, gamma: float, d: Tensor, next_value: Tensor, m: Tensor, n: int) -> Tensor:
    """Eq. 9: y_t = R_t + gamma (1 - d_t) V(h_{t+1}), ``reward`` is R_t; (B, T) each. No gradient.

    With n > 1 the n-step return, y_t = sum_{k<n} gamma^k R_{t+k} + gamma^n V(h_{t+n}), as R2D2 has it: not corrected
    for the policy that acted, and shorter where the window or the episode ends before. It is built from its end,
    y^n_t = R_t + gamma (1 - d_t) y^{n-1}_{t+1}, with V(h_{t+1}) for the latter where step t + 1 is not in the window.
    """
    y = reward + gamma * (1.0 - d) * next_value
    next_is_real = functional.pad(m[:, 1:], (0, 1)) > 0
    for _ in range(min(n, m.shape[1]) - 1):
        after = torch.where(next_is_real, functional.pad(y[:, 1:], (0, 1)), next_value)
        y = reward + gamma * (1.0 - d) * after
    return y.detach()


def q_loss(q: Tensor, y: Tensor, importance: Tensor, m: Tensor) -> Tensor:
    """Eq. 9: 1/2 sum_j (Q_j(h_t, a_t) - y_t)^2, importance-weighted per window; q (2, B, T), importance (B,).

    The half and the sum over both critics are SAC's; the paper prints one square.
    """
    squared = 0.5 * (q - y).square().sum(0)
    return masked_mean(importance.unsqueeze(1) * squared, m)


def policy_loss(log_pi: Tensor, q: Tensor, alpha: Tensor, m: Tensor) -> Tensor:
    """Eq. 11: alpha log pi(a|sg(h_t)) - Q(sg(h_t), a), (B, T) each. (The paper prints the sign the other way round.)

    Whether h_t is stopped is the scheme's (table 1): 4 to 6 let the gradient through.
    """
    return masked_mean(alpha.detach() * log_pi - q, m)


def temperature_loss(log_alpha: Tensor, log_pi: Tensor, target_entropy: float, m: Tensor) -> Tensor:
    """Eq. 12: -log alpha sg(log pi + target entropy). (The paper has alpha there, whose steps shrink as it does.)"""
    return -log_alpha * masked_mean(log_pi.detach() + target_entropy, m)


def grounding_loss(
    predicted: Tensor, observation: Tensor, predicted_reward: Tensor, r: Tensor, seen: Tensor, m: Tensor
) -> Tensor:
    """L1 of o_{t+1}, over the numbers that ``seen`` (B, T, M) marks, plus L1 of r_t.

    A missing o_{t+1} is not seen, nor is what follows a missing o_t that was not imputed. A reward is real there, too.
    """
    return observation_loss(predicted, observation, seen, m) + masked_mean((predicted_reward - r).abs(), m)


def observation_loss(expected: Tensor, observation: Tensor, seen: Tensor, m: Tensor) -> Tensor:
    """L1 of o_{t+1} (B, T, O), mean over what is ``seen`` (B, T, M). Alone it is ``fill_loss``, the imputer's."""
    by_flag = (expected - observation).abs().reshape(*seen.shape, -1).mean(-1)
    return masked_mean(by_flag, m.unsqueeze(-1) * seen)


def priority(td_size: Tensor, eta: float, m: Tensor) -> Tensor:
    """eta max|td| + (1 - eta) mean|td| over a window's real trained steps; |td| (B, T) -> (B,)."""
    size = td_size * m
    return eta * size.max(1).values + (1.0 - eta) * size.sum(1) / m.sum(1).clamp(min=1.0)
