"""Theta-bar of algorithm 1: the exponential moving average of the parameters of what acts.

It is saved and evaluated, and never sent to actors.
"""

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from rmc.common.agent import Agent

MOVE_UPDATES = 10  # updates between moves, which read and write all that acts


class PolicyAverage:
    """Its time constant is so many updates, early on a tenth of those made.

    With fewer than ``MOVE_UPDATES`` it is the newest parameters.
    """

    def __init__(self, agent: Agent, updates: int) -> None:
        self._agent, self._updates = agent, updates
        averaged = agent.acting() if updates >= MOVE_UPDATES else {}
        self._values = {name: value.detach().clone() for name, value in averaged.items()}

    @torch.no_grad()
    def update(self, updates: int, parts: tuple[str, ...] = ("",)) -> None:
        """Every ``MOVE_UPDATES`` updates, move the average of parameters whose names begin so; before, copy them."""
        if self._values and (updates < MOVE_UPDATES or updates % MOVE_UPDATES == 0):
            over, acting = min(self._updates, updates / 10) / MOVE_UPDATES, self._agent.acting()
            names = [name for name in self._values if name.startswith(parts)]
            newest: list[Tensor] = [acting[name] for name in names]
            torch._foreach_lerp_([self._values[name] for name in names], newest, 1.0 / max(1.0, over))

    def tensors(self, parts: tuple[str, ...]) -> Iterator[Tensor]:
        """The tensors whose names begin so, to be moved elsewhere in memory."""
        return (value for name, value in self._values.items() if name.startswith(parts))

    def policy_weights(self) -> dict[str, Tensor]:
        """On the host, with what normalises observations now."""
        return self._agent.policy_weights() | {name: value.cpu() for name, value in self._values.items()}

    def state_dict(self) -> dict[str, Tensor]:
        """By parameter."""
        return self._values

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Go on from these."""
        for name, value in self._values.items():
            value.copy_(state[name])
