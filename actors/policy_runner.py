"""The policy on the CPU, fast at small batches: every product and every result in a buffer of its own.

Shapes: N environments, O observation, A action, E embedding, H hidden, S state, M flags of what is missing.
Float32 throughout; agrees with ``rmc.common.agent`` (its modules are the reference) to 1e-5.
"""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from rmc.common.agent_config import CRITIC_PARTS, LOG_STD_RANGE, NORMALIZED_CLIP, AgentConfig
from rmc.common.errors import MessageError
from rmc.common.window import BoolArray, Floats


def _of_shape(weights: dict[str, Tensor], name: str, like: Tensor) -> Tensor:
    """Out of ``weights``. Raises KeyError, ValueError."""
    value = weights.pop(name)
    if value.shape != like.shape:
        raise ValueError(f"{name} has shape {tuple(value.shape)}, expected {tuple(like.shape)}")
    return value


def _check_finite(weights: dict[str, Tensor]) -> None:
    """Also of critics, which others use. Raises ValueError."""
    for name, value in weights.items():
        if value.dtype != torch.float32:
            raise ValueError(f"{name} has {value.dtype}, expected torch.float32")
        if value.numel() and not all(map(math.isfinite, value.aminmax())):  # a tenth of what isfinite takes
            raise ValueError(f"{name} holds NaN or infinity, expected finite weights")


PLAIN: dict[str, Any] = {"dtype": torch.float32, "device": "cpu"}  # whatever the caller's program has as default


_count_lock = threading.Lock()
_callers_counts: list[int] = []  # of those that are inside: the same for all, as the first has found it


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch's, for a policy's products: their last bits depend on it, and a process that has begun more cannot fork."""
    with _count_lock:
        _callers_counts.append(_callers_counts[0] if _callers_counts else torch.get_num_threads())
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _count_lock:  # also while others are inside: it is this thread's own, which they keep theirs of
            torch.set_num_threads(_callers_counts.pop())


class _Linear:
    """y = x W + b, then ReLU if asked, into ``out``.

    With W as (inputs, outputs) the BLAS reads it once, as it lies: at 8 rows that takes less than half of what packed
    weights or the transposed product take.
    """

    def __init__(self, inputs: int, outputs: int, rows: int, relu: bool = False) -> None:
        self._weight, self._bias = torch.zeros(inputs, outputs, **PLAIN), torch.zeros(outputs, **PLAIN)
        self.out, self._relu = torch.zeros(rows, outputs, **PLAIN), relu

    def take(self, weights: dict[str, Tensor], name: str) -> Callable[[], object]:
        """What is called ``name``, out of ``weights``; calling the result copies it. Raises KeyError, ValueError."""
        weight = _of_shape(weights, name.format("weight"), self._weight.T)
        bias = _of_shape(weights, name.format("bias"), self._bias)

        def copy() -> None:
            self._weight.copy_(weight.T)
            self._bias.copy_(bias)

        return copy

    def __call__(self, x: Tensor) -> Tensor:
        torch.addmm(self._bias, x, self._weight, out=self.out)
        return self.out.relu_() if self._relu else self.out


class _GRU:
    """r, z = sigmoid(...), n = tanh(x_n + r * h_n), h' = n + z (h - n), into ``out``; the parts are views made once."""

    def __init__(self, from_input: _Linear, from_hidden: _Linear, rows: int, size: int) -> None:
        self._from_input, self._from_hidden = from_input, from_hidden
        gates, new = slice(0, 2 * size), slice(2 * size, None)
        self._gates, self._new = from_input.out[:, gates], from_input.out[:, new]
        self._hidden_gates, self._hidden_new = from_hidden.out[:, gates], from_hidden.out[:, new]
        self._r, self._z = self._gates[:, :size], self._gates[:, size:]
        self.out = torch.empty(rows, size, **PLAIN)

    def __call__(self, x: Tensor, hidden: Tensor) -> Tensor:
        self._from_input(x)
        self._from_hidden(hidden)
        self._gates.add_(self._hidden_gates).sigmoid_()
        self._new.addcmul_(self._r, self._hidden_new).tanh_()
        return torch.lerp(self._new, hidden, self._z, out=self.out)


def _head(inputs: int, hidden: tuple[int, int], outputs: int, rows: int) -> tuple[_Linear, ...]:
    first, second = hidden
    relu = _Linear(inputs, first, rows, relu=True), _Linear(first, second, rows, relu=True)
    return (*relu, _Linear(second, outputs, rows))


class PolicyRunner:
    """Observation, previous action and state in; action and next state out, for N environments."""

    def __init__(self, obs_dim: int, action_dim: int, config: AgentConfig, envs: int, missing: int = 1) -> None:
        """``missing`` is M: 1, or O where the dimensions are missing one by one."""
        self._config, self._envs = config, envs
        self._obs_dim, self._action_dim = obs_dim, action_dim
        self._flags = missing * config.missing_flag
        inputs = config.input_size(obs_dim, action_dim, missing)
        embedding = config.embedding or inputs
        self._skip = config.skip_size(obs_dim)
        self._input = np.zeros((envs, inputs), np.float32)
        self._embed = _Linear(inputs, embedding, envs, relu=True) if config.embedding else None
        self._from_embedding = _Linear(embedding, 3 * config.hidden, envs)
        self._from_hidden = _Linear(config.hidden, 3 * config.hidden, envs)
        self._mean, self._std = torch.zeros(obs_dim, **PLAIN), torch.ones(obs_dim, **PLAIN)
        self.knows_statistics = False  # whether what was loaded normalises observations by some
        self._gru = _GRU(self._from_embedding, self._from_hidden, envs, config.hidden)
        self._head = _head(config.feature_size(self._skip), config.heads, 2 * action_dim, envs)
        input_dim = config.hidden + obs_dim + action_dim
        self._next_frame = _head(input_dim, config.heads, obs_dim, envs) if config.impute_missing else ()

    def start(self) -> tuple[Floats, Floats]:
        """Previous action (N, A) and state (N, S) at the start of episodes: new zeros."""
        sizes = (self._action_dim, self._config.state_size(self._obs_dim))
        prev_action, state = (np.zeros((self._envs, size), np.float32) for size in sizes)
        return prev_action, state

    def load(self, blob: bytes) -> None:
        """Take over the safetensors of ``Agent.policy_weights()``, or of what is broadcast. Raises MessageError."""
        try:
            weights = load(blob)
            _check_finite(weights)
            copies = self._copies(weights)
        except (SafetensorError, KeyError, ValueError) as error:
            raise MessageError("weights", f"not a policy of this run ({error})") from None
        rates = self._config.initial_priority == "actor"
        if unread := [name for name in weights if not (rates and name.startswith(CRITIC_PARTS))]:
            raise MessageError("weights", f"not a policy of this run (it also has {', '.join(unread)})")
        for copy in copies:  # only now, so that what is refused changes nothing
            copy()
        self.knows_statistics = bool(self._mean.any()) or bool((self._std != 1.0).any())

    def _copies(self, weights: dict[str, Tensor]) -> list[Callable[[], object]]:
        """What fills every part, once called; takes what it uses out of ``weights``."""
        layers = {"memory.gru.{}_ih_l0": self._from_embedding, "memory.gru.{}_hh_l0": self._from_hidden}
        for net, head in (("policy", self._head), ("next_frame", self._next_frame)):
            layers |= {f"{net}.net.{place}.{{}}": layer for place, layer in zip((0, 2, 4), head, strict=False)}
        if self._embed is not None:
            layers["memory.embed.0.{}"] = self._embed
        copies = [layer.take(weights, name) for name, layer in layers.items()]
        plain = {"normalizer.mean": self._mean, "normalizer.std": self._std}
        return copies + [partial(mine.copy_, _of_shape(weights, name, mine)) for name, mine in plain.items()]

    def act(
        self, observation: Floats, prev_action: Floats, missing: BoolArray, state: Floats, noise: Floats | None
    ) -> tuple[Floats, Floats]:
        """(N, O) raw, (N, A), (N, M), (N, S), and (N, A) standard normal noise -> (N, A) in [-1, 1], (N, S).

        a = tanh(mean + std * noise); without noise, tanh(mean). The state returned is a buffer that
        the next call may overwrite; none of the arguments is changed.
        """
        filled, hidden = self._read_input(observation, prev_action, missing), state[:, : self._config.hidden]
        if self._next_frame and missing.any():
            np.copyto(self._input[:, : self._obs_dim], self._expected(state, prev_action), where=missing)
        if self._config.head_input == "observation":
            x, new_hidden = filled[:, : self._obs_dim], self._gru.out.zero_()
        else:
            embedding = filled if self._embed is None else self._embed(filled)
            x = new_hidden = self._gru(embedding, torch.from_numpy(hidden))
            if self._skip:
                x = torch.cat([x, filled[:, : self._skip]], 1)
        for layer in self._head:
            x = layer(x)
        new_state: Floats = new_hidden.numpy()
        if self._next_frame:
            new_state = np.concatenate([new_state, self._input[:, : self._obs_dim]], 1)
        return self._action(x.numpy(), noise), new_state

    def _read_input(self, observation: Floats, prev_action: Floats, missing: BoolArray) -> Tensor:
        x = self._input
        normalized = x[:, : self._obs_dim]
        if self._config.normalize_observations:
            np.subtract(observation, self._mean.numpy(), out=normalized)
            np.divide(normalized, self._std.numpy(), out=normalized)
            np.minimum(normalized, NORMALIZED_CLIP, out=normalized)  # the two take a third of one clip
            np.maximum(normalized, -NORMALIZED_CLIP, out=normalized)
        else:
            normalized[:] = observation
        np.copyto(normalized, 0.0, where=missing)
        x[:, self._obs_dim : self._obs_dim + self._action_dim] = prev_action
        if self._flags:
            x[:, -self._flags :] = missing
        return torch.from_numpy(x)

    def _expected(self, state: Floats, prev_action: Floats) -> Floats:
        """(N, S), (N, A) -> (N, O), the normalised observation that fills what is missing."""
        x = torch.from_numpy(np.concatenate([state, prev_action], 1))
        for layer in self._next_frame:
            x = layer(x)
        last_frame = state[:, self._config.hidden :]
        expected: Floats = (last_frame + x.numpy()).clip(-NORMALIZED_CLIP, NORMALIZED_CLIP)
        return expected * last_frame.any(1, keepdims=True)

    def _action(self, head: Floats, noise: Floats | None) -> Floats:
        mean, log_std = head[:, : self._action_dim], head[:, self._action_dim :]
        if noise is None:
            return np.tanh(mean)
        least, most = LOG_STD_RANGE
        action: Floats = np.tanh(mean + np.exp(np.maximum(np.minimum(log_std, most), least)) * noise)
        return action
