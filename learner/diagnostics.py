"""What the learner measures of itself; nothing here changes what is learnt.

Shapes: B batch, T = L_b + L_t steps of a window, O observation, A action, H hidden, M flags of what is missing,
P privileged; n steps from an episode's start to a window's end.
Staleness is R2D2's (Kapturowski et al., 2019, section 3), with Q of the actions that were taken.
"""

import math
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from rmc.common.agent import Agent, MemoryOutput
from rmc.common.critic import critic_input
from rmc.common.window import BoolArray, Floats, Rows, WindowSpec
from rmc.learner import losses

SLICE = 4  # windows of a batch that are looked at


def model_metrics(
    of_losses: dict[str, Tensor], change: Tensor, curiosity: Tensor, terminated: Tensor, m: Tensor,
    norm: Literal["l1", "l2"],
) -> dict[str, Tensor]:  # fmt: skip
    """Scalars of the model's pass; ``change`` of h (B, L_t, H) is what it should predict, the others (B, L_t)."""
    unmoved = losses.model_error(torch.zeros_like(change), change, norm)
    no_change = losses.model_loss(unmoved, terminated, m)
    return of_losses | {
        "model_unexplained": of_losses["model_loss"] / no_change.clamp(min=1e-8),
        "curiosity_mean": losses.masked_mean(curiosity, m),
    }


def actor_critic_metrics(
    of_losses: dict[str, Tensor], alpha: Tensor, log_pi: Tensor, q: Tensor, td_error: Tensor, i: Tensor, r: Tensor,
    m: Tensor, beta: Tensor,
) -> dict[str, Tensor]:  # fmt: skip
    """Scalars of the critics' and the policy's pass, from what it computed without gradient.

    ``alpha`` and ``beta`` are scalars, q (2, B, L_t), curiosity i and the others (B, L_t).
    """
    return of_losses | {
        "alpha": alpha,
        "entropy": -losses.masked_mean(log_pi, m),
        "q_mean": losses.masked_mean(q.mean(0), m),
        "td_error": losses.masked_mean(td_error, m),
        "curiosity_share": beta * i.sum() / (beta * i.sum() + (m * r.abs()).sum()).clamp(min=1e-8),
    }


def unexplained_change(predicted: Tensor, change: Tensor, m: Tensor) -> Tensor:
    """(O,): mean size of the error over that of the change itself, by observation dimension; 1 is "no change".

    ``m`` (B, L_t, M), the others (B, L_t, O).
    """
    return relative_l1_error(*((m * x.abs()).sum((0, 1)) for x in (predicted - change, change)))


def relative_l1_error(error: Tensor, size: Tensor) -> Tensor:
    """(O,) error over size. What hardly changes counts as a thousandth of what changes most: else it is all noise."""
    return error / torch.maximum(size, 1e-3 * size.max()).clamp(min=1e-8)


def latent_rank(hidden: Tensor) -> tuple[float, float]:
    """Effective rank, exp(entropy of the normalised singular values), and mean per-unit standard deviation.

    ``hidden`` (..., H). A rank near 1 or a deviation near 0 is a collapsed latent; NaN is a diverged one.
    """
    flat = hidden.reshape(-1, hidden.shape[-1]).float()
    flat = flat - flat.mean(0)
    if not flat.isfinite().all():  # which svdvals does not take; the learner says so where it publishes
        return math.nan, math.nan
    p = torch.linalg.svdvals(flat)
    p = p / p.sum().clamp(min=1e-12)
    entropy = -(p * p.clamp(min=1e-12).log()).sum()
    return float(entropy.exp()), float(flat.std(0).mean())


def measurable(rows: Rows, spec: WindowSpec) -> BoolArray:
    """(B,) which windows are full and start after their episode did, when every state is zero."""
    whole: BoolArray = (rows["first"] == 0) & (rows["last"] == spec.steps) & (rows["episode_step"] > spec.burn_in)
    return whole


@torch.no_grad()
def staleness(agent: Agent, spec: WindowSpec, episode: Rows) -> dict[str, float]:
    """Of a ``measurable`` window, the last of ``episode``, which holds all windows from its episode's start on.

    ``stale_state_…``: |h_replayed - h_recomputed| / |h_recomputed|, before the window and after its burn-in.
    ``stale_q_…``: |Q(h_replayed) - Q(h_recomputed)| / max|Q|, at the first and the last of L_t steps, which start at
    the stored state (…_stored) or are those trained, after the burn-in (…_burned, where there is one).
    """
    device = agent.log_alpha.device
    joined = (torch.from_numpy(x).to(device).unsqueeze(0) for x in _joined(episode, spec))
    observation, missing, privileged, action = joined
    stored = torch.from_numpy(episode["state"][-1:].copy()).to(device)
    o = agent.normalizer(observation, missing)
    before, recomputed, replayed = _unrolled(agent, spec.steps, (o, missing, action), stored)
    beside = agent.normalized_privileged(privileged[:, -spec.steps - 1 : -1])
    q, q_replayed = (
        agent.critic(critic_input(agent.features(remembered), beside), action[:, -spec.steps :]).mean(0).squeeze(0)
        for remembered in (recomputed, replayed)
    )
    gap = (q_replayed - q).abs() / q.abs().max().clamp(min=1e-8)
    metrics = {
        "stale_state_stored": _distance(*(state[:, : agent.config.hidden] for state in (stored, before))),
        "stale_q_first_stored": gap[0],
        "stale_q_last_stored": gap[spec.train - 1],
    }
    if spec.burn_in:
        burned = spec.burn_in - 1
        metrics |= {
            "stale_state_burned": _distance(replayed.hidden[:, burned], recomputed.hidden[:, burned]),
            "stale_q_first_burned": gap[spec.burn_in],
            "stale_q_last_burned": gap[-1],
        }
    return {name: float(value) for name, value in metrics.items()}


def _unrolled(
    agent: Agent, steps: int, episode: tuple[Tensor, Tensor, Tensor], stored: Tensor
) -> tuple[Tensor, MemoryOutput, MemoryOutput]:
    """The state before the last window, recomputed (1, S), and the memory along it from that and from the stored one.

    ``episode`` is o (1, n + 1, O), what is missing (1, n + 1, M), actions (1, n, A).
    """
    o, missing, action = episode
    prev_action = torch.cat([torch.zeros_like(action[:, :1]), action], dim=1)
    past, window = slice(None, -steps - 1), slice(-steps - 1, -1)  # the bootstrap observation starts no step
    _, _, before = agent.unroll(o[:, past], missing[:, past], prev_action[:, past], torch.zeros_like(stored))
    recomputed, replayed = (
        agent.unroll(o[:, window], missing[:, window], prev_action[:, window], state)[0] for state in (before, stored)
    )
    return before, recomputed, replayed


def _distance(replayed: Tensor, recomputed: Tensor) -> Tensor:
    distance: Tensor = (replayed - recomputed).norm() / recomputed.norm().clamp(min=1e-8)
    return distance


def _joined(episode: Rows, spec: WindowSpec) -> tuple[Floats, BoolArray, Floats, Floats]:
    """Observations (n + 1, O), what is missing (n + 1, M), privileged (n + 1, P), and actions (n, A) of overlapping
    windows in order.
    """
    starts = episode["episode_step"] - spec.burn_in  # of the window's first slot, in steps of the episode
    n = int(starts[-1] + episode["last"][-1])
    observation, privileged = (np.zeros((n + 1, size), np.float32) for size in (spec.obs_dim, spec.privileged))
    missing, action = np.zeros((n + 1, spec.missing), np.bool_), np.zeros((n, spec.action_dim), np.float32)
    for row, start in zip(episode, starts.tolist(), strict=True):
        first, last = int(row["first"]), int(row["last"])
        for name, joined in (("observation", observation), ("missing", missing), ("privileged", privileged)):
            joined[start + first : start + last + 1] = row[name][first : last + 1]
        action[start + first : start + last] = row["action"][first:last]
    return observation, missing, privileged, action
