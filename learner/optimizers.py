"""Adam for parts of an agent, and its saved states."""

from typing import Any

import torch

from rmc.common.agent import Agent
from rmc.learner.config import UpdateConfig


def adam(agent: Agent, config: UpdateConfig, *parts: str) -> torch.optim.Adam:
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
    on_gpu = agent.log_alpha.device.type == "cuda"
    return torch.optim.Adam([group for group in groups if group["params"]], fused=True, capturable=on_gpu)


def by_optimizer(saved: list[dict[str, Any]], optimizers: list[torch.optim.Adam]) -> list[dict[str, Any]]:
    """The states of the optimizers; version 0.1.0 saved one for all parts, in the same order."""
    if len(saved) == len(optimizers):
        return saved
    states, begin = [], 0
    for optimizer in optimizers:
        groups = optimizer.state_dict()["param_groups"]
        end = begin + sum(len(group["params"]) for group in groups)
        moments = {number - begin: moment for number, moment in saved[0]["state"].items() if begin <= number < end}
        states.append({"state": moments, "param_groups": groups})
        begin = end
    return states


def begin_moments(optimizer: torch.optim.Adam) -> None:
    """Adam's moments, which it would make in its first step: where they are not loaded."""
    for parameter in (value for group in optimizer.param_groups for value in group["params"]):
        if parameter not in optimizer.state:
            zeros = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
            optimizer.state[parameter] = {"step": torch.zeros(()), **zeros}
