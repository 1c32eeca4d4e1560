"""A batch of rows as tensors: views into one block of bytes.

Shapes: B batch, T steps, O observation, A action, H hidden; L_b burn-in.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from common.window import Rows, WindowSpec

_TORCH_TYPES = {"<i8": torch.int64, "<i4": torch.int32, "<f4": torch.float32, "|u1": torch.uint8}


@dataclass(frozen=True)
class Batch:
    """What the update reads; everything outside the masks is zero."""

    observation: Tensor  # (B, T + 1, O) raw
    prev_action: Tensor  # (B, T + 1, A), a_{t-1}
    action: Tensor  # (B, T, A)
    reward: Tensor  # (B, T)
    terminated: Tensor  # (B, T), d_t: 1 at a true termination
    hidden: Tensor  # (B, H), the state before the first real observation
    blank: Tensor  # (B, T + 1) bool
    observation_valid: Tensor  # (B, T + 1) bool
    step_valid: Tensor  # (B, T) bool
    burned_in: Tensor  # (B,) bool: the burn-in is real
    importance: Tensor  # (B,)


def importance_weights(values: NDArray[np.float64], mass: float, windows: int, exponent: float) -> NDArray[np.float32]:
    """(N P(i))^-exponent / max, P(i) = value / mass, N windows: (B,) -> (B,)."""
    weights = (windows * values / mass) ** -exponent
    scaled: NDArray[np.float32] = (weights / weights.max()).astype(np.float32)
    return scaled


def _field(raw: Tensor, spec: WindowSpec, name: str) -> Tensor:
    fields = spec.dtype.fields
    assert fields is not None
    dtype, offset = fields[name][0], fields[name][1]
    kind = _TORCH_TYPES[dtype.base.str]
    flat = raw[:, offset : offset + dtype.itemsize].view(kind)
    return flat.reshape(raw.shape[0], *dtype.shape) if dtype.shape else flat.reshape(-1)


def clear_padding(rows: Rows, spec: WindowSpec) -> None:
    """Zero in place what is not real in (B,) rows, so that not even a NaN there can reach a sum or a gradient."""
    partial = np.flatnonzero((rows["first"] > 0) | (rows["last"] < spec.steps))
    t = np.arange(spec.observations)
    first, last = rows["first"][partial, None], rows["last"][partial, None]
    unobserved = (t < first) | (t > last)
    unstepped = (unobserved | (t == last))[:, :-1]
    for absent, names in ((unobserved, ("observation", "blank")), (unstepped, ("action", "reward"))):
        window, step = np.nonzero(absent)
        for name in names:
            rows[name][partial[window], step] = 0


def view_batch(raw: Tensor, importance: Tensor, spec: WindowSpec) -> Batch:
    """(B, row bytes) uint8 and (B,) float32, on any device, to a Batch; static shapes, no host sync.

    The rows' padding must be zero: see ``clear_padding``.
    """
    assert raw.shape[1] == spec.dtype.itemsize, (raw.shape, spec.dtype.itemsize)
    first, last = _field(raw, spec, "first"), _field(raw, spec, "last").unsqueeze(1)
    t = torch.arange(spec.observations, device=raw.device).unsqueeze(0)
    observation_valid = (first.unsqueeze(1) <= t) & (t <= last)
    action, prev = _field(raw, spec, "action"), _field(raw, spec, "prev_action")
    prev_action = torch.cat([torch.zeros_like(action[:, :1]), action], dim=1)
    prev_action.scatter_(1, first.long().view(-1, 1, 1).expand(-1, 1, prev.shape[1]), prev.unsqueeze(1))
    ends = (t[:, :-1] == last - 1) & (_field(raw, spec, "terminated").unsqueeze(1) > 0)
    return Batch(
        observation=_field(raw, spec, "observation"),
        prev_action=prev_action,
        action=action,
        reward=_field(raw, spec, "reward"),
        terminated=ends.float(),
        hidden=_field(raw, spec, "hidden"),
        blank=_field(raw, spec, "blank") > 0,
        observation_valid=observation_valid,
        step_valid=observation_valid[:, :-1] & (t[:, :-1] < last),
        burned_in=first == 0,
        importance=importance,
    )
