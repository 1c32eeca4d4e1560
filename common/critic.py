"""The critics: twin Q, where configured with batch norm instead of target networks.

Shapes: B batch, T time, N = B T, K units, Z head input, A action, P privileged.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rmc.common.agent_config import AgentConfig

VARIANCE_EPS = 1e-3  # added, so that a unit that hardly moves is not blown up
MOMENTUM = 0.01  # of the running statistics: a batch's share in them


class StackedLinear(nn.Module):
    """Two Linear layers side by side as one batched product: x (1 or 2, N, in) -> (2, N, out)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        bound = 1.0 / math.sqrt(inputs)  # nn.Linear's own initialisation
        self.weight = nn.Parameter(torch.empty(2, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(2, 1, outputs).uniform_(-bound, bound))

    def forward(self, x: Tensor) -> Tensor:
        return torch.baddbmm(self.bias, x.expand(2, -1, -1), self.weight)


class BatchNorm(nn.Module):
    """Each unit minus its mean, over its standard deviation; where asked, times a gain, plus an offset."""

    mean: Tensor  # (nets, 1, K), running
    variance: Tensor

    def __init__(self, nets: int, size: int, affine: bool) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(nets, 1, size))
        self.register_buffer("variance", torch.ones(nets, 1, size))
        self.gain = nn.Parameter(torch.ones(nets, 1, size)) if affine else None
        self.offset = nn.Parameter(torch.zeros(nets, 1, size)) if affine else None

    def forward(self, x: Tensor, share: Tensor | None = None) -> Tensor:
        """(nets, N, K) -> the same in float32, by the running statistics, or by those of x, which move them.

        ``share`` (N,) is each row's in them; they add up to 1.
        """
        x = x.float()
        mean, variance = self.mean, self.variance
        if share is not None:
            weight = share.unsqueeze(-1)
            mean = (weight * x).sum(1, keepdim=True)
            variance = (weight * (x - mean).square()).sum(1, keepdim=True)
            self.mean.lerp_(mean.detach(), MOMENTUM)
            self.variance.lerp_(variance.detach(), MOMENTUM)
        normed = (x - mean) * (variance + VARIANCE_EPS).rsqrt()
        return normed if self.gain is None or self.offset is None else normed * self.gain + self.offset


class TwinQ(nn.Module):
    """Eq. 9: Q_1(h, a) and Q_2(h, a), stacked; where configured with batch norm of all that a layer reads."""

    def __init__(self, inputs: int, action_dim: int, config: AgentConfig) -> None:
        super().__init__()
        sizes = inputs + action_dim, *config.heads
        layers = [StackedLinear(*pair) for pair in zip(sizes, (*config.heads, 1), strict=True)]
        if config.critic_batch_norm:  # few actions among many states, all of one size, would be learnt of last
            with torch.no_grad():
                layers[0].weight[:, inputs:] *= math.sqrt(inputs / action_dim)
        self.layers = nn.ModuleList(layers)
        # both nets read the same input; without an offset behind the ReLUs, the last bias alone would carry Q's mean
        norms = [BatchNorm(1, sizes[0], affine=False), *(BatchNorm(2, size, affine=True) for size in config.heads)]
        self.norms = nn.ModuleList(norms if config.critic_batch_norm else [])

    def forward(self, features: Tensor, action: Tensor, m: Tensor | None = None) -> Tensor:
        """(B, T, Z + P), (B, T, A) -> (2, B, T) in float32.

        Given the mask m (B, T), batch norm takes the statistics of these steps, where they are real.
        """
        x = torch.cat([features, action.to(features.dtype)], dim=-1).flatten(0, -2).unsqueeze(0)
        share = None if m is None else shares(m)
        for depth, layer in enumerate(self.layers[:-1]):
            x = F.relu(layer(self._normed(x, depth, share)))
        with torch.autocast(x.device.type, enabled=False):  # bfloat16 would give a Q of 300 in steps of 2
            q: Tensor = self.layers[-1](self._normed(x, -1, share).float())
        return q.reshape(2, *features.shape[:-1])

    def _normed(self, x: Tensor, depth: int, share: Tensor | None) -> Tensor:
        if not self.norms:
            return x
        normed: Tensor = self.norms[depth](x, share)
        return normed


def shares(m: Tensor) -> Tensor:
    """(B, T) -> (N,): what each step counts for in a mean over the real ones."""
    return (m / m.sum().clamp(min=1.0)).flatten()


def critic_input(z: Tensor, privileged: Tensor) -> Tensor:
    """What critics read: (B, T, Z), (B, T, P) normalised -> (B, T, Z + P)."""
    return torch.cat([z, privileged.to(z.dtype)], dim=-1) if privileged.shape[-1] else z
