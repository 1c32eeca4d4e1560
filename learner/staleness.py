"""How stale replayed states are: what a window starts from, against what today's weights would remember there.

Shapes: n steps from an episode's start to a window's end, T = L_b + L_t steps of the window, O observation, A action.
The measures are those of R2D2 (Kapturowski et al., 2019, section 3), with Q of the actions that were taken.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rmc.common.agent import Agent
from rmc.common.window import BoolArray, Rows, WindowSpec

Floats = NDArray[np.float32]
SLICE = 4  # windows of a batch that are looked at


def measurable(rows: Rows, spec: WindowSpec) -> BoolArray:
    """(B,) which windows are full and start after their episode did, when every state is zero."""
    found: BoolArray = (rows["first"] == 0) & (rows["last"] == spec.steps) & (rows["episode_step"] > spec.burn_in)
    return found


@torch.no_grad()
def staleness(agent: Agent, spec: WindowSpec, episode: Rows) -> dict[str, float]:
    """Of a ``measurable`` window, the last of ``episode``, which holds all windows from its episode's start on.

    ``stale_state_…``: |h_replayed - h_recomputed| / |h_recomputed|, before the window and after its burn-in.
    ``stale_q_…``: |Q(h_replayed) - Q(h_recomputed)| / max|Q|, at the first and the last of L_t steps, which start at
    the stored state (…_stored) or are those trained, after the burn-in (…_burned, where there is one).
    """
    device = agent.log_alpha.device
    observation, blank, action = (torch.from_numpy(x).to(device).unsqueeze(0) for x in _joined(episode, spec))
    stored = torch.from_numpy(episode["state"][-1:].copy()).to(device)
    o, start = agent.normalizer(observation, blank), torch.zeros_like(stored)
    prev_action = torch.cat([torch.zeros_like(action[:, :1]), action], dim=1)
    window = slice(-spec.steps - 1, -1)  # its steps; the bootstrap observation starts none
    past = slice(None, -spec.steps - 1)
    _, _, before = agent.remember(o[:, past], blank[:, past], prev_action[:, past], start)
    replayed, recomputed = (
        agent.remember(o[:, window], blank[:, window], prev_action[:, window], state)[0] for state in (stored, before)
    )
    q, q_replayed = (
        agent.critic(agent.features(remembered), action[:, -spec.steps :]).mean(0).squeeze(0)
        for remembered in (recomputed, replayed)
    )
    gap = (q_replayed - q).abs() / q.abs().max().clamp(min=1e-8)
    found = {
        "stale_state_stored": _distance(*(state[:, : agent.config.hidden] for state in (stored, before))),
        "stale_q_first_stored": gap[0],
        "stale_q_last_stored": gap[spec.train - 1],
    }
    if spec.burn_in:
        burned = spec.burn_in - 1
        found |= {
            "stale_state_burned": _distance(replayed.hidden[:, burned], recomputed.hidden[:, burned]),
            "stale_q_first_burned": gap[spec.burn_in],
            "stale_q_last_burned": gap[-1],
        }
    return {name: float(value) for name, value in found.items()}


def _distance(replayed: Tensor, recomputed: Tensor) -> Tensor:
    distance: Tensor = (replayed - recomputed).norm() / recomputed.norm().clamp(min=1e-8)
    return distance


def _joined(episode: Rows, spec: WindowSpec) -> tuple[Floats, BoolArray, Floats]:
    """Observations (n + 1, O), which of them are blank (n + 1,), and actions (n, A) of overlapping windows in order."""
    starts = episode["episode_step"] - spec.burn_in  # of the window's first slot, in steps of the episode
    n = int(starts[-1] + episode["last"][-1])
    observation = np.zeros((n + 1, spec.obs_dim), np.float32)
    blank, action = np.zeros(n + 1, np.bool_), np.zeros((n, spec.action_dim), np.float32)
    for row, start in zip(episode, starts.tolist(), strict=True):
        first, last = int(row["first"]), int(row["last"])
        observation[start + first : start + last + 1] = row["observation"][first : last + 1]
        blank[start + first : start + last + 1] = row["blank"][first : last + 1]
        action[start + first : start + last] = row["action"][first:last]
    return observation, blank, action
