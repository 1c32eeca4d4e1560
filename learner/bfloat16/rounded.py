"""Weights that are kept in bfloat16, too, for the products of a CPU: rounded once an update, not once a product."""

from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

BF16 = torch.bfloat16


def applies(x: Tensor) -> bool:
    """Whether the products of x are to be in bfloat16: under autocast, on a CPU."""
    return x.device.type == "cpu" and torch.is_autocast_enabled("cpu") and torch.get_autocast_dtype("cpu") is BF16


def bits(x: Tensor) -> NDArray[np.uint16]:
    """bfloat16 as ``learner/bfloat16/kernels.py`` takes it, the same memory."""
    same: NDArray[np.uint16] = x.view(torch.uint16).numpy()
    return same


class Rounded(nn.Module):
    """A module that keeps its weights in bfloat16, too, rounded again where one was written since.

    That is seen by torch's version of it, which neither ``.data`` nor numba raises: ``CompiledAdam`` rounds itself.
    """

    def weights(self) -> list[Tensor]:
        """Those that products in bfloat16 read."""
        raise NotImplementedError

    def bf16(self) -> list[Tensor]:
        """The bfloat16 copies, always in the same memory."""
        weights, state = self.weights(), self.__dict__
        versions = [weight._version for weight in weights]
        if "_rounded" not in state:
            state["_rounded"] = [torch.empty_like(weight, dtype=BF16) for weight in weights]
        if state.get("_versions") != versions:
            for low, weight in zip(state["_rounded"], weights, strict=True):
                low.copy_(weight.detach())
            state["_versions"] = versions
        rounded: list[Tensor] = state["_rounded"]
        return rounded


def rounded_weights(modules: Iterable[nn.Module]) -> dict[Tensor, Tensor]:
    """By weight, its bfloat16 copy, of all modules that have some."""
    parts = [part for module in modules for part in module.modules() if isinstance(part, Rounded)]
    return {weight: low for part in parts for weight, low in zip(part.weights(), part.bf16(), strict=True)}
