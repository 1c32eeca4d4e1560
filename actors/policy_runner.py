"""The policy on the CPU, fast at small batches: plain numpy over preallocated buffers, one thread.

Shapes: N environments, O observation, A action, E embedding, H hidden. Float32 throughout; agrees with
``common.agent`` (its modules are the reference) to 1e-5.
"""

import itertools

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load

from common.agent import LOG_STD_RANGE, NORMALIZED_CLIP, AgentConfig
from common.errors import MessageError
from common.window import BoolArray

Floats = NDArray[np.float32]
_LAYER_NORM_EPSILON = 1e-5  # torch's default


class _Linear:
    """y = x W^T + b into its own buffer."""

    def __init__(self, weight: Floats, bias: Floats, rows: int) -> None:
        self._weight = np.ascontiguousarray(weight).T
        self._bias = bias
        self._out = np.empty((rows, len(bias)), np.float32)

    def __call__(self, x: Floats) -> Floats:
        np.matmul(x, self._weight, out=self._out)
        self._out += self._bias
        return self._out


def _relu(x: Floats) -> Floats:
    return np.maximum(x, 0.0, out=x)


def _sigmoid(x: Floats) -> Floats:
    """In place, by tanh, which does not overflow."""
    x *= 0.5
    np.tanh(x, out=x)
    x *= 0.5
    x += 0.5
    return x


class PolicyRunner:
    """Observation, previous action and hidden state in; action and next hidden state out, for N environments."""

    def __init__(self, obs_dim: int, action_dim: int, config: AgentConfig, envs: int) -> None:
        self._config, self._envs = config, envs
        self._obs_dim, self._action_dim = obs_dim, action_dim
        self._input = np.empty((envs, obs_dim + action_dim), np.float32)
        self._embedding_dim = config.embedding or obs_dim + action_dim
        self._features = np.empty((envs, config.hidden + self._embedding_dim), np.float32)

    def start(self) -> tuple[Floats, Floats]:
        """Previous action (N, A) and hidden state (N, H) at the start of episodes: new zeros."""
        sizes = (self._action_dim, self._config.hidden)
        prev_action, hidden = (np.zeros((self._envs, size), np.float32) for size in sizes)
        return prev_action, hidden

    def load(self, blob: bytes) -> None:
        """Take over the safetensors of ``Agent.policy_weights()``. Raises MessageError."""
        try:
            weights = load(blob)
            self._take(weights)
        except (SafetensorError, KeyError, ValueError) as error:
            raise MessageError("weights", f"not a policy of this run ({error})") from None
        if weights:
            raise MessageError("weights", f"not a policy of this run (it also has {', '.join(weights)})")

    def _take(self, weights: dict[str, Floats]) -> None:
        """Build the layers; takes what it uses out of ``weights``."""
        config, embedding = self._config, self._embedding_dim
        inputs = self._obs_dim + self._action_dim
        features = config.hidden + (embedding if config.shortcut else 0)
        self._mean, self._std = weights.pop("normalizer.mean"), weights.pop("normalizer.std")
        self._embed, self._norm = None, None
        if config.embedding:
            self._embed = self._linear(weights, "memory.embed.0.{}", inputs, embedding)
        if config.embedding and config.layer_norm:
            self._norm = weights.pop("memory.embed.1.weight"), weights.pop("memory.embed.1.bias")
        self._from_embedding = self._linear(weights, "memory.gru.{}_ih_l0", embedding, 3 * config.hidden)
        self._from_hidden = self._linear(weights, "memory.gru.{}_hh_l0", config.hidden, 3 * config.hidden)
        sizes = (features, *config.heads, 2 * self._action_dim)
        self._head = [
            self._linear(weights, f"policy.net.{2 * i}.{{}}", *pair) for i, pair in enumerate(itertools.pairwise(sizes))
        ]

    def _linear(self, weights: dict[str, Floats], name: str, inputs: int, outputs: int) -> _Linear:
        weight, bias = weights.pop(name.format("weight")), weights.pop(name.format("bias"))
        if weight.shape != (outputs, inputs):
            raise ValueError(f"{name} has shape {weight.shape}, expected {(outputs, inputs)}")
        return _Linear(weight, bias, self._envs)

    def act(
        self, observation: Floats, prev_action: Floats, blank: BoolArray, hidden: Floats, noise: Floats | None
    ) -> tuple[Floats, Floats]:
        """(N, O) raw, (N, A), (N,), (N, H), and (N, A) standard normal noise -> (N, A) in [-1, 1], (N, H).

        a = tanh(mean + std * noise); without noise, tanh(mean). The hidden state returned is a view that
        the next call overwrites; none of the arguments is changed.
        """
        embedding = self._embedded(observation, prev_action, blank)
        new_hidden = self._remember(embedding, hidden)
        x = new_hidden
        if self._config.shortcut:
            self._features[:, self._config.hidden :] = embedding
            x = self._features
        for layer in self._head[:-1]:
            x = _relu(layer(x))
        out = self._head[-1](x)
        mean, log_std = out[:, : self._action_dim], out[:, self._action_dim :]
        if noise is None:
            return np.tanh(mean), new_hidden
        return np.tanh(mean + np.exp(log_std.clip(*LOG_STD_RANGE)) * noise), new_hidden

    def _embedded(self, observation: Floats, prev_action: Floats, blank: BoolArray) -> Floats:
        x = self._input
        normalized = x[:, : self._obs_dim]
        np.subtract(observation, self._mean, out=normalized)
        np.divide(normalized, self._std, out=normalized)
        np.clip(normalized, -NORMALIZED_CLIP, NORMALIZED_CLIP, out=normalized)
        normalized[blank] = 0.0
        x[:, self._obs_dim :] = prev_action
        if self._embed is None:
            return x
        embedding = self._embed(x)
        if self._norm is not None:
            scale, shift = self._norm
            embedding -= embedding.mean(1, keepdims=True)
            variance = np.square(embedding).mean(1, keepdims=True)
            embedding /= np.sqrt(variance + _LAYER_NORM_EPSILON)
            embedding *= scale
            embedding += shift
        return _relu(embedding)

    def _remember(self, embedding: Floats, hidden: Floats) -> Floats:
        """GRU: r, z = sigmoid(...), n = tanh(x_n + r * h_n), h' = n + z (h - n)."""
        size = self._config.hidden
        x, h = self._from_embedding(embedding), self._from_hidden(hidden)
        gates = x[:, : 2 * size]
        gates += h[:, : 2 * size]
        _sigmoid(gates)
        r, z, new = gates[:, :size], gates[:, size:], x[:, 2 * size :]
        r *= h[:, 2 * size :]
        new += r
        np.tanh(new, out=new)
        out = self._features[:, :size]
        np.subtract(hidden, new, out=out)
        out *= z
        out += new
        return out
