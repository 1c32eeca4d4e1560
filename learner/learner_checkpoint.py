"""What the learner writes into a checkpoint's files, and takes up from them."""

import io
import json
import pickle
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from rmc.common.checkpoint import POLICY, PROGRESS, STATE
from rmc.common.replay import ObservationStatistics
from rmc.learner.update import JointUpdate

COUNTED = ("updates", "env_steps", "epoch", "threads", "policy_learnt")
NOT_OURS = (pickle.UnpicklingError, EOFError, RuntimeError, LookupError, ValueError, TypeError, AttributeError)


@dataclass(frozen=True)
class LearnerProgress:
    """How far a learner has come, beside its networks."""

    updates: int
    env_steps: int
    epoch: int
    threads: int = 0  # that its trial has chosen, 0 before
    observed_before: ObservationStatistics | None = None  # by the run that this one began with
    policy_learnt: bool = False  # by that run

    def encode(self) -> bytes:
        """As JSON, with the time."""
        numbers: dict[str, Any] = {name: getattr(self, name) for name in COUNTED}
        if self.observed_before is not None and self.observed_before.count.any():
            numbers["observed_before"] = self.observed_before.to_json()
        return json.dumps(numbers | {"time": time.time()}).encode()

    @staticmethod
    def decode(raw: bytes) -> "LearnerProgress":
        """Raises one of NOT_OURS."""
        numbers = json.loads(raw)
        before = numbers.get("observed_before")
        return LearnerProgress(
            int(numbers["updates"]),
            int(numbers["env_steps"]),
            int(numbers["epoch"]),
            int(numbers.get("threads", 0)),
            None if before is None else ObservationStatistics.from_json(before),
            bool(numbers.get("policy_learnt", False)),
        )


def pack(state: dict[str, Any], policy: bytes, progress: LearnerProgress) -> dict[str, bytes]:
    """A checkpoint's files of ``JointUpdate.state_dict()``, the policy's file and how far training has come."""
    packed = io.BytesIO()
    torch.save(_alone(state), packed)
    return {STATE: packed.getvalue(), POLICY: policy, PROGRESS: progress.encode()}


def _alone(state: Any) -> Any:
    """Nested dicts and lists with a copy of each tensor: torch.save takes along whatever lies in the same memory."""
    if isinstance(state, Tensor):
        return state.clone()
    if isinstance(state, dict):
        return {name: _alone(part) for name, part in state.items()}
    return [_alone(part) for part in state] if isinstance(state, list) else state


def read_state(files: Mapping[str, bytes], device: torch.device) -> dict[str, Any]:
    """A checkpoint's ``JointUpdate.state_dict``, by tensors alone: nothing in it runs. Raises one of NOT_OURS."""
    state: dict[str, Any] = torch.load(io.BytesIO(files[STATE]), map_location=device, weights_only=True)
    return state


def take_up(files: Mapping[str, bytes], update: JointUpdate, device: torch.device) -> LearnerProgress:
    """Go on from a checkpoint's files, bit for bit. Raises one of NOT_OURS where they are not this run's."""
    update.load_state_dict(read_state(files, device))
    return LearnerProgress.decode(files[PROGRESS])


def all_finite(state: Any) -> bool:
    """Whether every number of every tensor in nested dicts and lists is."""
    return all(map(_is_finite, _tensors_in(state)))


def _tensors_in(state: Any) -> Iterator[Tensor]:
    if isinstance(state, Tensor):
        yield state
    elif isinstance(state, dict | list):
        for part in state.values() if isinstance(state, dict) else state:
            yield from _tensors_in(part)


def _is_finite(values: Tensor) -> bool:
    """Their sum is finite only where they all are, and takes a CPU a fraction of the time."""
    return bool(values.sum().isfinite()) or bool(values.isfinite().all())  # large ones may overflow it
