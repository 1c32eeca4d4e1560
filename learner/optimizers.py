"""Adam for parts of an agent, on a CPU in one pass over memory; its saved states; Polyak's average."""

import inspect
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from rmc.common.agent import Agent
from rmc.learner.bfloat16 import kernels
from rmc.learner.bfloat16.rounded import rounded_weights
from rmc.learner.config import UpdateConfig

NOT_ROUNDED = np.empty(0, np.uint16)


class CompiledAdam(torch.optim.Adam):
    """torch's Adam by ``learner/bfloat16/kernels.py``, which rounds weights for the next products in the same pass."""

    # torch's own, without the decorator that imports its compiler, 1.5 s, only to keep the compiler off them
    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Adam.load_state_dict)

    def __init__(self, groups: list[dict[str, Any]], rounded: Mapping[Tensor, Tensor]) -> None:
        """``rounded`` has, by weight, its bfloat16 copy, which a step writes, too."""
        super().__init__(groups, fused=True)
        self._rounded = rounded

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Move all that has a gradient, each with a step count of its own."""
        assert closure is None
        for group in self.param_groups:
            rates = group["lr"], *group["betas"], group["eps"]
            moving = [parameter for parameter in group["params"] if parameter.grad is not None]
            begin_moments(self, moving)
            for parameter in moving:
                self._move(parameter, rates)

    def _move(self, parameter: Tensor, rates: tuple[float, ...]) -> None:
        state, gradient = self.state[parameter], parameter.grad
        assert gradient is not None
        moments = _flat(state["exp_avg"]), _flat(state["exp_avg_sq"])
        bf16, step = _bf16_copy(self._rounded, parameter), state["step"].view(1).numpy()
        assert all(moment.size == parameter.numel() for moment in moments)  # the kernel does not look
        kernels.adam(_flat(parameter), _flat(gradient), *moments, bf16, step, *rates)


@torch.no_grad()
def polyak_update(target: nn.Module, source: nn.Module, weight: float) -> None:
    """target <- target + weight (source - target), parameter by parameter; ``weight`` from 0 to 1."""
    torch._foreach_lerp_(list(target.parameters()), list(source.parameters()), weight)


def _flat(tensor: Tensor) -> NDArray[np.float32]:
    """Its numbers as they lie in memory: (K,)."""
    flat: NDArray[np.float32] = tensor.detach().view(-1).numpy()
    return flat


def _bf16_copy(rounded: Mapping[Tensor, Tensor], weight: Tensor) -> NDArray[np.uint16]:
    """(K,) its copy in bfloat16, or (0,) where there is none."""
    bf16 = rounded.get(weight)
    return NOT_ROUNDED if bf16 is None else bf16.view(-1).view(torch.uint16).numpy()


def make_adam(agent: Agent, config: UpdateConfig, *parts: str) -> torch.optim.Adam:
    """Adam for the parts of the agent that are named; memory and temperature have step sizes of their own."""
    heads = [part for part in parts if part not in ("memory", "log_alpha") and getattr(agent, part) is not None]
    memory = list(agent.memory.parameters()) if "memory" in parts else []
    groups = [
        {"params": memory, "lr": config.learning_rate * config.memory_learning_scale},
        {
            "params": [value for part in heads for value in getattr(agent, part).parameters()],
            "lr": config.learning_rate,
        },
        {"params": [agent.log_alpha] if "log_alpha" in parts else [], "lr": config.alpha_learning_rate},
    ]
    groups = [group for group in groups if group["params"]]
    device = agent.log_alpha.device.type
    if device != "cpu":
        return torch.optim.Adam(groups, fused=True, capturable=device == "cuda")
    return CompiledAdam(groups, rounded_weights(getattr(agent, part) for part in ["memory", *heads]))


def by_optimizer(saved: list[dict[str, Any]], optimizers: list[torch.optim.Adam]) -> list[dict[str, Any]]:
    """The states of the optimizers; checkpoints of before there were two have one for all parts, in the same order."""
    if len(saved) == len(optimizers):
        return saved
    if len(saved) != 1:
        raise ValueError(f"{len(saved)} optimizers where this order of updates has {len(optimizers)}")
    states, begin = [], 0
    for optimizer in optimizers:
        groups = optimizer.state_dict()["param_groups"]
        end = begin + sum(len(group["params"]) for group in groups)
        moments = {number - begin: moment for number, moment in saved[0]["state"].items() if begin <= number < end}
        states.append({"state": moments, "param_groups": groups})
        begin = end
    return states


def begin_moments(optimizer: torch.optim.Adam, parameters: Iterable[Tensor]) -> None:
    """Adam's moments, which it would make in its first step: where they are not loaded."""
    for parameter in parameters:
        if parameter not in optimizer.state:
            zeros = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
            optimizer.state[parameter] = {"step": torch.zeros(()), **zeros}
