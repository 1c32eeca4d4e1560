"""A batch of rows as tensors: views into one block of bytes.

Shapes: B batch, T steps, O observation, A action, S state, M flags of what is missing, P privileged; L_b burn-in.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rmc.common.window import Rows, WindowSpec

SHORTEST_CUT = 16  # trained steps down to which windows are cut: below, an update costs what its weights do


class Plan(NamedTuple):
    """What the host decides of an update before it runs, so that no device has to be asked."""

    steps: int  # of each window, L_b and up to L_t
    imputes: bool  # whether a frame may be missing, and is filled
    trains_imputer: bool
    trains_policy: bool


@dataclass(frozen=True)
class Batch:
    """What the update reads, as it was seen; zero outside the masks."""

    observation: Tensor  # (B, T + 1, O) raw
    prev_action: Tensor  # (B, T + 1, A), a_{t-1}
    action: Tensor  # (B, T, A)
    reward: Tensor  # (B, T)
    terminated: Tensor  # (B, T), d_t: 1 at a true termination
    state: Tensor  # (B, S), the state before the first real observation
    missing: Tensor  # (B, T + 1, M) bool
    privileged: Tensor  # (B, T + 1, P) raw
    observation_valid: Tensor  # (B, T + 1) bool
    step_valid: Tensor  # (B, T) bool
    burned_in: Tensor  # (B,) bool: the burn-in is real
    importance: Tensor  # (B,)
    burn_in: int  # L_b
    cut: int  # steps of padding that all its windows have after the T
    plan: Plan

    @property
    def trained(self) -> slice:
        """The steps after the burn-in, of the T or the T + 1."""
        return slice(self.burn_in, None)


def importance_weights(weights: NDArray[np.float64], exponent: float) -> NDArray[np.float32]:
    """(N P(i))^-exponent / max, N windows, P(i) in proportion to the weights, so that both cancel: (B,) -> (B,)."""
    importance: NDArray[np.float32] = ((weights / weights.min()) ** -exponent).astype(np.float32)
    return importance


@cache
def _places(spec: WindowSpec) -> dict[str, tuple[tuple[int, ...], tuple[int, ...], int]]:
    """Shape, strides and offset of each field of a row, in steps of its items."""
    places = {}
    for name, (dtype, offset, *_) in (spec.dtype.fields or {}).items():
        strides = tuple(int(np.prod(dtype.shape[axis + 1 :])) for axis in range(len(dtype.shape)))
        places[name] = dtype.shape, strides, offset // dtype.base.itemsize
    return places


def _real(first: Any, last: Any, t: Any) -> tuple[Any, Any]:
    """Which observations and steps of windows are no padding: (B, 1), (B, 1), (1, T + 1) -> (B, T + 1), (B, T)."""
    observed = (first <= t) & (t <= last)
    return observed, observed[:, :-1] & (t[:, :-1] < last)


def clear_padding(rows: Rows, spec: WindowSpec) -> None:
    """Zero in place what is not real in (B,) rows, so that not even a NaN there can reach a sum or a gradient."""
    partial = np.flatnonzero((rows["first"] > 0) | (rows["last"] < spec.steps))
    t = np.arange(spec.observations)[None]
    observed, stepped = _real(rows["first"][partial, None], rows["last"][partial, None], t)
    for real, names in ((observed, ("observation", "missing", "privileged")), (stepped, ("action", "reward"))):
        window, step = np.nonzero(~real)
        for name in names:
            rows[name][partial[window], step] = 0


def longest_steps(raw: Tensor, spec: WindowSpec) -> int:
    """Steps up to where the longest window of (B, row bytes) on the host is real; what comes after pads all of them.

    Trained steps are rounded up to 2^k or 3 * 2^(k-1), from ``SHORTEST_CUT`` on, so that updates have few shapes.
    """
    trained = int(raw.view(torch.int32)[:, _places(spec)["last"][2]].max()) - spec.burn_in
    size = max(SHORTEST_CUT, 1 << (trained - 1).bit_length())
    if size > SHORTEST_CUT and trained <= size // 4 * 3:
        size = size // 4 * 3
    return min(spec.steps, spec.burn_in + size)


def has_missing(raw: Tensor, spec: WindowSpec) -> bool:
    """Whether a frame of (B, row bytes) on the host is missing."""
    return bool(_field(raw, spec, "missing").any())


def _field(items: Tensor, spec: WindowSpec, name: str) -> Tensor:
    """(B, row bytes), seen as items of that field's type, to (B, ...): a view."""
    shape, strides, offset = _places(spec)[name]
    return items.as_strided((len(items), *shape), (items.stride(0), *strides), items.storage_offset() + offset)


def view_batch(raw: Tensor, importance: Tensor, spec: WindowSpec, plan: Plan | None = None) -> Batch:
    """(B, row bytes) uint8 and (B,) float32, on any device, to a Batch; static shapes, no host sync.

    The rows' padding must be zero: see ``clear_padding``. Without a plan, all steps, and nothing is left out.
    """
    assert raw.shape[1] == spec.dtype.itemsize, (raw.shape, spec.dtype.itemsize)
    plan = plan or Plan(spec.steps, True, True, True)
    steps = plan.steps
    floats, integers = raw.view(torch.float32), raw.view(torch.int32)

    def field(items: Tensor, name: str) -> Tensor:
        return _field(items, spec, name)

    first, last = field(integers, "first"), field(integers, "last").unsqueeze(1)
    action, prev = field(floats, "action")[:, :steps], field(floats, "prev_action")
    prev_action = torch.cat([torch.zeros_like(action[:, :1]), action], dim=1)
    prev_action.scatter_(1, first.long().view(-1, 1, 1).expand(-1, 1, prev.shape[1]), prev.unsqueeze(1))
    t = torch.arange(steps + 1, dtype=torch.int32, device=raw.device).unsqueeze(0)
    observation_valid, step_valid = _real(first.unsqueeze(1), last, t)
    ends = (t[:, :-1] == last - 1) & (field(integers, "terminated").unsqueeze(1) > 0)
    return Batch(
        observation=field(floats, "observation")[:, : steps + 1],
        prev_action=prev_action,
        action=action,
        reward=field(floats, "reward")[:, :steps],
        terminated=ends.float(),
        state=field(floats, "state"),
        missing=field(raw, "missing")[:, : steps + 1] > 0,
        privileged=field(floats, "privileged")[:, : steps + 1],
        observation_valid=observation_valid,
        step_valid=step_valid,
        burned_in=first == 0,
        importance=importance,
        burn_in=spec.burn_in,
        cut=spec.steps - steps,
        plan=plan,
    )
