"""The agent's networks: memory, world model, imputer, policy, temperature; critics are in ``common/critic.py``.

Shapes: B batch, T time, O observation, A action, H hidden, S state, E embedding, Z = H, O or H + O head input, M flags
of what is missing (1 for a whole frame, or O), P privileged numbers, which critics alone read.
Equations are in ``learner/losses.py``; here is only what maps inputs to outputs. What must be fast is written again:
``learner/bfloat16/`` for bfloat16 on a CPU, ``actors/policy_runner.py`` for acting; tests compare them with this.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rmc.common.agent_config import CRITIC_PARTS, LOG_STD_RANGE, NORMALIZED_CLIP, POLICY_PARTS, STD_FLOOR, AgentConfig
from rmc.common.critic import TwinQ
from rmc.common.window import WindowSpec


class Normalizer(nn.Module):
    """(o - mean) / std by the statistics it was given last, within ±10, or o itself where that is off.

    What is missing is zero.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, obs_dim: int, enabled: bool) -> None:
        super().__init__()
        self.enabled = enabled
        self.register_buffer("mean", torch.zeros(obs_dim))
        self.register_buffer("std", torch.ones(obs_dim))

    def forward(self, observation: Tensor, missing: Tensor) -> Tensor:
        """(..., O) raw and (..., M) bool -> (..., O)."""
        return torch.where(missing, 0.0, self.scaled(observation))

    def scaled(self, observation: Tensor) -> Tensor:
        """(..., O) raw -> (..., O), where nothing is missing."""
        if not self.enabled:
            return observation
        return ((observation - self.mean) / self.std).clamp(-NORMALIZED_CLIP, NORMALIZED_CLIP)

    def freeze(self, count: Tensor, total: Tensor, total_square: Tensor) -> None:
        """Take new statistics from sums over ``count`` numbers of each dimension, of fewer than 2 none; (O,) each."""
        enough, count = count >= 2, count.clamp(min=1)
        mean = total / count
        variance = (total_square / count - mean * mean).clamp(min=0.0)
        self.mean.copy_(torch.where(enough, mean, self.mean))
        self.std.copy_(torch.where(enough, variance.sqrt().clamp(min=STD_FLOOR), self.std))


class MemoryOutput(NamedTuple):
    """What the memory makes of a sequence."""

    hidden: Tensor  # (B, T, H), h_t after (o_t, a_{t-1}); zeros without a memory
    skip: Tensor  # (B, T, ·), what the heads read beside it: o_t, or nothing


class Memory(nn.Module):
    """Eq. 6: h_t = GRU(h_{t-1}, e_t), e_t = ReLU(Linear([o_t, a_{t-1}])) or the raw input.

    Where asked, with M flags of what is missing beside o_t.
    """

    def __init__(self, obs_dim: int, action_dim: int, config: AgentConfig, missing: int = 1) -> None:
        super().__init__()
        width = config.input_size(obs_dim, action_dim, missing)
        self.missing_flag, self.head_input = config.missing_flag, config.head_input
        layers: list[nn.Module] = []
        if config.embedding:
            layers = [nn.Linear(width, config.embedding), nn.ReLU()]
        self.embed = nn.Sequential(*layers)
        self.skip_dim = config.skip_size(obs_dim)
        self.gru = nn.GRU(config.embedding or width, config.hidden, batch_first=True)

    def forward(self, observation: Tensor, missing: Tensor, prev_action: Tensor, hidden: Tensor) -> MemoryOutput:
        """(B, T, O) normalised, (B, T, M) bool, (B, T, A), (B, S) the state before the first, which begins with h."""
        if self.head_input == "observation":
            return MemoryOutput(observation.new_zeros(*observation.shape[:2], self.gru.hidden_size), observation)
        embedding = self._embedded(observation, missing, prev_action)
        hidden = self._unroll(embedding, hidden[:, : self.gru.hidden_size].unsqueeze(0).contiguous())
        return MemoryOutput(hidden, self.skip(observation))

    @torch.no_grad()
    def start_gates(self, steps: int) -> None:
        """Chrono initialisation: unit i holds what it has for 1 + u_i steps, u_i from 1 to ``steps`` - 1.

        With z = sigmoid(b), h_t = z h_{t-1} + (1 - z) n_t keeps h for about 1 / (1 - z) = 1 + e^b steps, so b_i = log
        u_i (Tallec and Ollivier, 2018, for the GRU).
        """
        size = self.gru.hidden_size
        gate = slice(size, 2 * size)  # PyTorch's order: reset, update, candidate
        _, _, from_input, from_hidden = self.gru.all_weights[0]
        from_input[gate] = torch.empty(size).uniform_(1.0, max(2.0, steps - 1.0)).log()
        from_hidden[gate] = 0.0

    def step(self, observation: Tensor, missing: Tensor, prev_action: Tensor, hidden: Tensor) -> Tensor:
        """One step of it: (B, O) normalised, (B, M) bool, (B, A), (B, H) -> (B, H) float32."""
        if self.head_input == "observation":
            return torch.zeros_like(hidden)
        embedding = self._embedded(observation, missing, prev_action)
        return torch.gru_cell(embedding, hidden, *self.gru.all_weights[0])

    def skip(self, observation: Tensor) -> Tensor:
        """What the heads read beside h: (..., O) normalised -> (..., O), or (..., 0)."""
        return observation[..., : self.skip_dim]

    def inputs(self, observation: Tensor, missing: Tensor, prev_action: Tensor) -> Tensor:
        """What is embedded: (..., O) normalised, (..., M) bool, (..., A) -> (..., O + A), or M more with the flags."""
        flag = [missing.to(observation.dtype)] if self.missing_flag else []
        return torch.cat([observation, prev_action, *flag], dim=-1)

    def _embedded(self, observation: Tensor, missing: Tensor, prev_action: Tensor) -> Tensor:
        """(..., O) normalised, (..., M) bool, (..., A) -> (..., E)."""
        embedding: Tensor = self.embed(self.inputs(observation, missing, prev_action))
        return embedding

    def _unroll(self, embedding: Tensor, hidden: Tensor) -> Tensor:
        """(B, T, E), (1, B, H) -> (B, T, H) float32."""
        if embedding.is_cuda:  # autocast would run cuDNN's GRU in float16, whatever type it is told
            with torch.autocast("cuda", enabled=False):
                sequence: Tensor = self.gru(embedding.float(), hidden)[0]
        else:
            sequence = self.gru(embedding, hidden)[0]
        return sequence


def _mlp(inputs: int, hidden: tuple[int, int], last: nn.Linear) -> nn.Sequential:
    first, second = hidden
    return nn.Sequential(nn.Linear(inputs, first), nn.ReLU(), nn.Linear(first, second), nn.ReLU(), last)


class Float32Linear(nn.Linear):
    """A last layer that stays float32 under autocast, for what bfloat16's 8 bits would round too much."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.float())


class Prediction(NamedTuple):
    """One step ahead, from (z_t, a_t)."""

    hidden_change: Tensor  # (B, T, H), of h_{t+1} - h_t
    observation_change: Tensor  # (B, T, O), of the normalised o_{t+1} - o_t; O = 0 without grounding
    reward: Tensor  # (B, T), or zeros without grounding


class WorldModel(nn.Module):
    """Eq. 7: f(h_t, a_t): predicts the change of the hidden state, and the grounding signals if asked."""

    def __init__(self, inputs: int, obs_dim: int, action_dim: int, config: AgentConfig) -> None:
        super().__init__()
        self.sizes = [config.hidden, *((obs_dim, 1) if config.grounding else (0, 0))]
        self.net = _mlp(inputs + action_dim, config.heads, nn.Linear(config.heads[1], sum(self.sizes)))

    def forward(self, features: Tensor, action: Tensor) -> Prediction:
        """(B, T, Z), (B, T, A)."""
        out = self.net(torch.cat([features, action.to(features.dtype)], dim=-1))
        hidden_change, observation_change, reward = out.split(self.sizes, dim=-1)
        return Prediction(hidden_change, observation_change, reward.sum(-1))


class ObservationImputer(nn.Module):
    """g(h_t, o_t, a_t): the normalised o_{t+1} that fills a missing frame. It trains nothing but itself.

    It reads o_t, whatever the heads read. It is not the world model: where one did both, returns fell
    (``studies/notebook.md``).
    """

    def __init__(self, obs_dim: int, action_dim: int, config: AgentConfig) -> None:
        super().__init__()
        self.net = _mlp(config.hidden + obs_dim + action_dim, config.heads, nn.Linear(config.heads[1], obs_dim))

    def forward(self, hidden: Tensor, observation: Tensor, action: Tensor) -> Tensor:
        """(..., H), (..., O) normalised, (..., A) -> (..., O) in float32."""
        change: Tensor = self.net(torch.cat([x.to(hidden.dtype) for x in (hidden, observation, action)], dim=-1))
        return observation + change.float()


class GaussianPolicy(nn.Module):
    """Squashed Gaussian with a state-dependent standard deviation."""

    def __init__(self, inputs: int, action_dim: int, config: AgentConfig) -> None:
        super().__init__()
        self.net = _mlp(inputs, config.heads, Float32Linear(config.heads[1], 2 * action_dim))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """(..., Z) -> mean and log standard deviation before the tanh, (..., A) each, float32."""
        mean, log_std = self.net(features).chunk(2, dim=-1)
        return mean, log_std.clamp(*LOG_STD_RANGE)


def squashed_sample(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Eq. 10: a = tanh(u), u = mean + std * noise, and its log density; (..., A) -> (..., A), (...).

    log pi(a) = sum log N(u) - log(1 - tanh(u)^2), the latter as 2 (log 2 - u - softplus(-2u)), which
    does not overflow (SAC, appendix C, in its stable form).
    """
    u = mean + log_std.exp() * noise
    log_normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2.0 * math.pi)
    log_slope = 2.0 * (math.log(2.0) - u - F.softplus(-2.0 * u))
    return torch.tanh(u), (log_normal - log_slope).sum(-1)


class Agent(nn.Module):
    """The complete agent: memory, world model, critics, policy, temperature.

    Actors are sent ``normalizer``, ``memory`` and ``policy``; ``next_frame`` where missing frames are filled, and
    ``critic`` where they rate their windows.
    """

    def __init__(
        self, obs_dim: int, action_dim: int, config: AgentConfig, missing: int = 1, privileged: int = 0
    ) -> None:
        """``missing`` is M, ``privileged`` is P."""
        super().__init__()
        self.config, self.obs_dim, self.action_dim = config, obs_dim, action_dim
        self.normalizer = Normalizer(obs_dim, config.normalize_observations)
        self.memory = Memory(obs_dim, action_dim, config, missing)
        features = config.feature_size(self.memory.skip_dim)
        self.world_model = WorldModel(features, obs_dim, action_dim, config)
        self.critic = TwinQ(features + privileged, action_dim, config)
        self.policy = GaussianPolicy(features, action_dim, config)
        self.log_alpha = nn.Parameter(torch.zeros(()))
        self.next_frame = ObservationImputer(obs_dim, action_dim, config) if config.impute_missing else None
        self.privileged_normalizer = Normalizer(privileged, config.normalize_observations) if privileged else None

    def features(self, remembered: MemoryOutput) -> Tensor:
        """What the heads read: h_t, what is beside it, or both."""
        match self.config.head_input:
            case "hidden":
                return remembered.hidden
            case "observation":
                return remembered.skip
        return torch.cat(remembered, dim=-1)

    def normalized_privileged(self, privileged: Tensor) -> Tensor:
        """What critics read beside z: (..., P) raw -> (..., P)."""
        return privileged if self.privileged_normalizer is None else self.privileged_normalizer.scaled(privileged)

    def freeze_statistics(self, count: Tensor, total: Tensor, total_square: Tensor) -> None:
        """Take new statistics of observations, then of what is privileged: (1,) or (O + P,) and twice (O + P,)."""
        sums = count.expand_as(total), total, total_square
        self.normalizer.freeze(*(numbers[: self.obs_dim] for numbers in sums))
        if self.privileged_normalizer is not None:
            self.privileged_normalizer.freeze(*(numbers[self.obs_dim :] for numbers in sums))

    @torch.no_grad()
    def impute(self, observation: Tensor, missing: Tensor, prev_action: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """What is missing of o_t becomes what is expected from (h_{t-1}, o_{t-1}, a_{t-1}), o_{t-1} filled itself.

        (B, T, O) normalised, (B, T, M) bool, (B, T, A), (B, S) the state before the first step -> (B, T, O) and the
        state after the last, within ±10. No gradient. Until an episode's first frame is seen it is zeros, the mean.
        """
        assert self.next_frame is not None
        hidden, last_frame = state[:, : self.config.hidden], state[:, self.config.hidden :]
        frames = [observation[:, :0]]
        with torch.autocast(observation.device.type, enabled=False):  # at a step at a time the casts outweigh the rest
            for o, was_missing, a in zip(observation.unbind(1), missing.unbind(1), prev_action.unbind(1), strict=True):
                expected = self.next_frame(hidden, last_frame, a).clamp(-NORMALIZED_CLIP, NORMALIZED_CLIP)
                expected = expected * (last_frame != 0).any(-1, keepdim=True)
                last_frame = torch.where(was_missing, expected, o)
                hidden = self.memory.step(last_frame, was_missing, a, hidden)
                frames.append(last_frame.unsqueeze(1))
        return torch.cat(frames, 1), torch.cat([hidden, last_frame], 1)

    def unroll(
        self, observation: Tensor, missing: Tensor, prev_action: Tensor, state: Tensor
    ) -> tuple[MemoryOutput, Tensor, Tensor]:
        """The memory along a sequence; what it read, (B, T, O), missing frames filled; the state after, (B, S)."""
        if self.may_impute(missing):
            filled, after = self.impute(observation, missing, prev_action, state)
            return self.memory(filled, missing, prev_action, state), filled, after
        remembered: MemoryOutput = self.memory(observation, missing, prev_action, state)
        last_frame = observation[:, -1, : state.shape[1] - self.config.hidden]
        return remembered, observation, torch.cat([remembered.hidden[:, -1], last_frame], 1)

    def may_impute(self, missing: Tensor) -> bool:
        """Whether there may be anything to fill; a GPU would have to wait to be asked, an export cannot ask."""
        cannot_ask = missing.device.type != "cpu" or torch.compiler.is_exporting()
        return self.config.impute_missing and (cannot_ask or bool(missing.any()))

    def acting(self) -> dict[str, nn.Parameter]:
        """The parameters that it takes to act, by name."""
        return {name: value for name, value in self.named_parameters() if name.startswith(POLICY_PARTS)}

    def policy_weights(self) -> dict[str, Tensor]:
        """What it takes to act, detached, on the CPU: what fills missing frames, too, where they are filled."""
        return self._weights(POLICY_PARTS)

    def policy_shapes(self) -> dict[str, tuple[int, ...]]:
        """Of ``policy_weights``; also of an agent on the device ``meta``, which takes no memory."""
        state = self.state_dict().items()
        return {name: tuple(value.shape) for name, value in state if name.startswith(POLICY_PARTS)}

    def broadcast_weights(self) -> dict[str, Tensor]:
        """What actors are sent: the critics, too, where they rate their windows."""
        return self._weights(POLICY_PARTS + (CRITIC_PARTS if self.config.initial_priority == "actor" else ()))

    def _weights(self, parts: tuple[str, ...]) -> dict[str, Tensor]:
        return {
            name: value.detach().cpu().contiguous()
            for name, value in self.state_dict().items()
            if name.startswith(parts)
        }


def initial_agent(spec: WindowSpec, config: AgentConfig, seed: int) -> Agent:
    """As it is before anything is learnt. Torch's own random numbers go on as if none had been drawn."""
    drawn = torch.get_rng_state()
    torch.default_generator.manual_seed(seed)  # a GPU's stay as they are
    try:
        agent = Agent(spec.obs_dim, spec.action_dim, config, spec.missing, spec.privileged)
        if config.gate_init == "chrono":
            agent.memory.start_gates(spec.steps)
    finally:
        torch.set_rng_state(drawn)
    return agent
