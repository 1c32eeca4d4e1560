"""A batch of rows as tensors: views into one block of bytes, copied only where padding becomes zero.

Shapes: B batch, T steps, O observation, A action, H hidden; L_b burn-in.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from common.window import WindowSpec

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


def view_batch(raw: Tensor, importance: Tensor, spec: WindowSpec) -> Batch:
    """(B, row bytes) uint8 and (B,) float32, on any device, to a Batch; static shapes, no host sync.

    Padding is replaced by zeros here, so that not even a NaN in it can reach a sum or a gradient.
    """
    assert raw.shape[1] == spec.dtype.itemsize, (raw.shape, spec.dtype.itemsize)
    first, last = _field(raw, spec, "first").unsqueeze(1), _field(raw, spec, "last").unsqueeze(1)
    t = torch.arange(spec.observations, device=raw.device).unsqueeze(0)
    observation_valid = (first <= t) & (t <= last)
    step_valid = observation_valid[:, :-1] & (t[:, :-1] < last)
    action = _where(step_valid, _field(raw, spec, "action"))
    shifted = torch.cat([torch.zeros_like(action[:, :1]), action], dim=1)
    at_first = (t == first).unsqueeze(-1)
    prev_action = torch.where(at_first, _field(raw, spec, "prev_action").unsqueeze(1), shifted)
    ends = (t[:, :-1] == last - 1) & (_field(raw, spec, "terminated").unsqueeze(1) > 0)
    return Batch(
        observation=_where(observation_valid, _field(raw, spec, "observation")),
        prev_action=_where(observation_valid, prev_action),
        action=action,
        reward=torch.where(step_valid, _field(raw, spec, "reward"), 0.0),
        terminated=ends.float(),
        hidden=_field(raw, spec, "hidden"),
        blank=(_field(raw, spec, "blank") > 0) & observation_valid,
        observation_valid=observation_valid,
        step_valid=step_valid,
        burned_in=(first == 0).squeeze(1),
        importance=importance,
    )


def _where(valid: Tensor, x: Tensor) -> Tensor:
    return torch.where(valid.unsqueeze(-1), x, 0.0)
