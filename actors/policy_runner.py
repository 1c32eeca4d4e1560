"""The policy on the CPU, fast at small batches: packed products, and numpy in place for the rest.

Shapes: N environments, O observation, A action, E embedding, H hidden. Float32 throughout; agrees with
``common.agent`` (its modules are the reference) to 1e-5.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load

from common.agent import CRITIC_PARTS, LOG_STD_RANGE, NORMALIZED_CLIP, AgentConfig
from common.errors import MessageError
from common.window import BoolArray

Floats = NDArray[np.float32]
_LAYER_NORM_EPSILON = 1e-5  # torch's default
_PACKED_FROM = 800_000  # multiplications of a layer; below, oneDNN's 13 us per call are not won back


class _PlainLinear:
    """y = x W^T + b, then ReLU if asked, into its own buffer."""

    def __init__(self, weight: Floats, bias: Floats, rows: int, relu: bool) -> None:
        self._weight, self._bias, self._relu = weight.T, bias, relu
        self._out = np.empty((rows, len(bias)), np.float32)

    def __call__(self, x: Floats) -> Floats:
        np.matmul(x, self._weight, out=self._out)
        self._out += self._bias
        return np.maximum(self._out, 0.0, out=self._out) if self._relu else self._out


class _PackedLinear:
    """The same by oneDNN on packed weights: half of a BLAS's time at these batch sizes."""

    def __init__(self, weight: Floats, bias: Floats, rows: int, relu: bool) -> None:
        self._weight = torch.ops.mkldnn._reorder_linear_weight(torch.from_numpy(weight), rows)
        self._bias = torch.from_numpy(bias)
        self._activation = "relu" if relu else "none"

    def __call__(self, x: Floats) -> Floats:
        linear = torch.ops.mkldnn._linear_pointwise
        y: Floats = linear(torch.from_numpy(x), self._weight, self._bias, self._activation, [], "").numpy()
        return y


def _has_packed_linear() -> bool:
    """Whether this torch was built with oneDNN, and still has the operators that pack weights."""
    names = ("_reorder_linear_weight", "_linear_pointwise")
    available = bool(torch.backends.mkldnn.is_available())  # type: ignore[no-untyped-call]
    return available and all(hasattr(torch.ops.mkldnn, name) for name in names)


def _make_linear(weight: Floats, bias: Floats, rows: int, relu: bool) -> _PackedLinear | _PlainLinear:
    packed = _has_packed_linear() and rows * weight.size >= _PACKED_FROM
    return (_PackedLinear if packed else _PlainLinear)(weight, bias, rows, relu)


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
        self._inputs = obs_dim + action_dim + config.blank_flag
        self._input = np.empty((envs, self._inputs), np.float32)
        self._embedding_dim = config.embedding or self._inputs
        self._hidden = np.empty((envs, config.hidden), np.float32)

    def start(self) -> tuple[Floats, Floats]:
        """Previous action (N, A) and hidden state (N, H) at the start of episodes: new zeros."""
        sizes = (self._action_dim, self._config.hidden)
        prev_action, hidden = (np.zeros((self._envs, size), np.float32) for size in sizes)
        return prev_action, hidden

    def load(self, blob: bytes) -> None:
        """Take over the safetensors of ``Agent.policy_weights()``, or of what is broadcast. Raises MessageError."""
        try:
            weights = load(blob)
            self._take(weights)
        except (SafetensorError, KeyError, ValueError) as error:
            raise MessageError("weights", f"not a policy of this run ({error})") from None
        rates = self._config.initial_priority == "actor"
        if left := [name for name in weights if not (rates and name.startswith(CRITIC_PARTS))]:
            raise MessageError("weights", f"not a policy of this run (it also has {', '.join(left)})")

    def _take(self, weights: dict[str, Floats]) -> None:
        """Build the layers; takes what it uses out of ``weights``."""
        config, embedding = self._config, self._embedding_dim
        features = config.hidden + (embedding if config.shortcut else 0)
        self._mean, self._std = weights.pop("normalizer.mean"), weights.pop("normalizer.std")
        self._embed, self._norm = None, None
        if config.embedding:
            self._embed = self._linear(
                weights, "memory.embed.0.{}", self._inputs, embedding, relu=not config.layer_norm
            )
        if config.embedding and config.layer_norm:
            self._norm = weights.pop("memory.embed.1.weight"), weights.pop("memory.embed.1.bias")
        self._from_embedding = self._linear(weights, "memory.gru.{}_ih_l0", embedding, 3 * config.hidden)
        self._from_hidden = self._linear(weights, "memory.gru.{}_hh_l0", config.hidden, 3 * config.hidden)
        first, second = config.heads
        self._head = (
            self._linear(weights, "policy.net.0.{}", features, first, relu=True),
            self._linear(weights, "policy.net.2.{}", first, second, relu=True),
            self._linear(weights, "policy.net.4.{}", second, 2 * self._action_dim),
        )

    def _linear(
        self, weights: dict[str, Floats], name: str, inputs: int, outputs: int, relu: bool = False
    ) -> _PackedLinear | _PlainLinear:
        weight, bias = weights.pop(name.format("weight")), weights.pop(name.format("bias"))
        if weight.shape != (outputs, inputs):
            raise ValueError(f"{name} has shape {weight.shape}, expected {(outputs, inputs)}")
        return _make_linear(weight, bias, self._envs, relu)

    def act(
        self, observation: Floats, prev_action: Floats, blank: BoolArray, hidden: Floats, noise: Floats | None
    ) -> tuple[Floats, Floats]:
        """(N, O) raw, (N, A), (N,), (N, H), and (N, A) standard normal noise -> (N, A) in [-1, 1], (N, H).

        a = tanh(mean + std * noise); without noise, tanh(mean). The hidden state returned is a buffer that
        the next call overwrites; none of the arguments is changed.
        """
        embedding = self._embedded(observation, prev_action, blank)
        new_hidden = self._remember(embedding, hidden)
        x = np.concatenate([new_hidden, embedding], 1) if self._config.shortcut else new_hidden
        for layer in self._head:
            x = layer(x)
        mean, log_std = x[:, : self._action_dim], x[:, self._action_dim :]
        if noise is None:
            return np.tanh(mean), new_hidden
        return np.tanh(mean + np.exp(log_std.clip(*LOG_STD_RANGE)) * noise), new_hidden

    def _embedded(self, observation: Floats, prev_action: Floats, blank: BoolArray) -> Floats:
        x = self._input
        normalized = x[:, : self._obs_dim]
        if self._config.normalize_observations:
            np.subtract(observation, self._mean, out=normalized)
            np.divide(normalized, self._std, out=normalized)
            np.clip(normalized, -NORMALIZED_CLIP, NORMALIZED_CLIP, out=normalized)
        else:
            normalized[:] = observation
        normalized[blank] = 0.0
        x[:, self._obs_dim : self._obs_dim + self._action_dim] = prev_action
        if self._config.blank_flag:
            x[:, -1] = blank
        if self._embed is None:
            return x
        embedding = self._embed(x)
        return embedding if self._norm is None else self._normalised(embedding, *self._norm)

    @staticmethod
    def _normalised(x: Floats, scale: Floats, shift: Floats) -> Floats:
        """LayerNorm, then ReLU, in place."""
        x -= x.mean(1, keepdims=True)
        x /= np.sqrt(np.square(x).mean(1, keepdims=True) + _LAYER_NORM_EPSILON)
        x *= scale
        x += shift
        return np.maximum(x, 0.0, out=x)

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
        out = np.subtract(hidden, new, out=self._hidden)
        out *= z
        out += new
        return out
