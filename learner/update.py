"""The joint update: all losses from the parameters as they stood, one backward, one step; or one after the other.

Shapes: B batch, L_b burn-in, L_t trained steps, O observation, A action, H hidden, S state, Z head input.
Nothing here waits for the host: no ``.item()``, no branch on a tensor, static shapes.
"""

import copy
import zlib
from collections.abc import Iterable
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.func import functional_call

from rmc.common.agent import Agent, MemoryOutput, Prediction, squashed_sample
from rmc.learner import losses
from rmc.learner.batch import Batch
from rmc.learner.config import UpdateConfig
from rmc.learner.diagnostics import Trace, unexplained_change, update_metrics
from rmc.learner.fused import fuse
from rmc.learner.unroll import impute, unroll

ModuleT = TypeVar("ModuleT", bound=nn.Module)
AVERAGE_UPDATES = 10  # updates between moves of the policy's average, which reads and writes all that acts
TRAINS_MEMORY = {  # the paper's table 1
    1: {"model", "value"},
    2: {"value"},
    3: {"model"},
    4: {"model", "value", "policy"},
    5: {"model", "policy"},
    6: {"value", "policy"},
}


class UpdateResult(NamedTuple):
    """What an update gives back, all on the device and without gradient."""

    priorities: Tensor  # (B,)
    metrics: dict[str, Tensor]  # scalars
    curiosity_variance: Tensor  # (2,), as it is after this batch
    hidden: Tensor  # (B, L_t + 1, H), for the latent's rank
    observed: Tensor  # (B, L_t + 1) bool, which of them are real
    observation_unexplained: Tensor  # (O,), see ``diagnostics.unexplained_change``; (0,) without grounding


class JointUpdate:
    """Agent, targets and optimiser, and the update that moves them together."""

    def __init__(self, agent: Agent, burn_in: int, config: UpdateConfig, seed: int, bf16: bool = False) -> None:
        device = agent.log_alpha.device
        if bf16 and device.type == "cpu":
            fuse(agent)
        self.agent, self.burn_in, self.config, self.bf16 = agent, burn_in, config, bf16
        self.target_critic = _target_copy(agent.critic)
        self.target_memory = _target_copy(agent.memory)
        self.average = {name: value.detach().clone() for name, value in agent.acting().items()}  # theta-bar
        self._has_target_memory = "ema" in (config.latent_target, config.target_memory)
        self.optimizers = self._make_optimizers()
        self.generator = torch.Generator(device).manual_seed(seed)
        self.curiosity_variance = torch.zeros(2, device=device)  # running mean, and the weight it has gathered

    def _make_optimizers(self) -> list[torch.optim.Adam]:
        return [_adam(self.agent, self.config, "memory", "world_model", "next_frame", "critic", "policy", "log_alpha")]

    def __call__(self, batch: Batch, beta: Tensor) -> UpdateResult:
        """One update from a Batch; ``beta`` is a scalar tensor."""
        loss_values, updated = self.forward(batch, beta)
        norm = self._step(self.optimizers[0], loss_values.values())
        self._follow(updated)
        return updated._replace(metrics=updated.metrics | {"grad_norm": norm})

    def forward(self, batch: Batch, beta: Tensor) -> tuple[dict[str, Tensor], UpdateResult]:
        """Every loss from the parameters as they stand, in the order of the paper's section 3."""
        agent, c = self.agent, self.config
        steps = slice(self.burn_in, None)
        a, r, d = batch.action[:, steps], batch.reward[:, steps], batch.terminated[:, steps]
        m = batch.step_valid[:, steps].float()
        alpha = agent.log_alpha.exp().detach()
        with torch.no_grad():
            o = agent.normalizer(batch.observation, batch.missing)
        with self._autocast():
            # Memory: h_t from the stored state, burned in without gradient
            o = impute(agent, o, batch, self.burn_in)
            memory = unroll(agent.memory, o, batch, self.burn_in)
            z = self._to_bf16(agent.features(memory))
            trains = TRAINS_MEMORY[c.scheme]
            z_model, z_value, z_policy = (z if loss in trains else z.detach() for loss in ("model", "value", "policy"))

            # Prediction, and curiosity from its error
            target = self._unroll_target(o, batch) if self._has_target_memory else memory
            latent = (target if c.latent_target == "ema" else memory).hidden.detach().float()
            prediction = agent.world_model(z_model[:, :-1], a)
            change = latent[:, 1:] - latent[:, :-1]
            error = losses.model_error(prediction.hidden_change.float(), change, c.model_norm)
            i, curiosity_variance = self._scaled(losses.curiosity(error, d, m), m)

            # Intuition: one policy sample for every step serves both the target and the policy loss
            mean, log_std = agent.policy(z_policy)
            pi, log_pi = squashed_sample(mean, log_std, self._noise_like(mean))
            with torch.no_grad():
                next_z = (self._to_bf16(agent.features(target)) if c.target_memory == "ema" else z)[:, 1:]
                next_q = self.target_critic(next_z, pi[:, 1:])
                next_value = losses.soft_value(next_q, alpha, log_pi[:, 1:])
                y = losses.td_target(r + beta * i, c.gamma, d, next_value, m, c.n_step)
            q = agent.critic(z_value[:, :-1], a)
            frozen = {name: value.detach() for name, value in agent.critic.named_parameters()}
            z_actor = z_policy if c.policy_through_q else z.detach()
            q_pi = functional_call(agent.critic, frozen, (z_actor[:, :-1], pi[:, :-1]))
            q_pi = q_pi[0] if c.policy_q == "first" else q_pi.min(0).values

        log_pi, td_error = log_pi[:, :-1], (q.detach() - y).abs().mean(0)
        loss_values = {
            "model_loss": losses.model_loss(error, d, m),
            "q_loss": losses.q_loss(q, y, batch.importance, m),
            "policy_loss": losses.policy_loss(log_pi, q_pi, alpha, m),
            "temperature_loss": losses.temperature_loss(agent.log_alpha, log_pi, -float(a.shape[-1]), m),
        }
        observation_losses, unexplained = self._observation_losses(o, memory, prediction, batch, m)
        loss_values |= observation_losses
        detached = {name: value.detach() for name, value in loss_values.items()}
        trace = Trace(detached, alpha, log_pi.detach(), q.detach(), td_error, i, change, r, d, m)
        return loss_values, UpdateResult(
            priorities=losses.priority(td_error, c.eta, m),
            metrics=update_metrics(trace, beta, c.model_norm),
            curiosity_variance=curiosity_variance,
            hidden=memory.hidden.detach(),
            observed=batch.observation_valid[:, steps],
            observation_unexplained=unexplained,
        )

    def _observation_losses(
        self, o: Tensor, memory: MemoryOutput, prediction: Prediction, batch: Batch, m: Tensor
    ) -> tuple[dict[str, Tensor], Tensor]:
        """The losses of what predicts observations, where configured, and what the world model leaves unexplained."""
        agent, steps = self.agent, slice(self.burn_in, None)
        a, r, seen = batch.action[:, steps], batch.reward[:, steps], _seen(batch)[:, steps]
        now, after, seen_now, seen_after = o[:, steps][:, :-1], o[:, steps][:, 1:], seen[:, :-1], seen[:, 1:]
        loss_values = {}
        if agent.next_frame is not None:
            with self._autocast():
                expected = agent.next_frame(self._to_bf16(memory.hidden.detach()[:, :-1]), now, a)
            loss_values["fill_loss"] = losses.fill_loss(expected, after, seen_after, m)
        if not agent.config.grounding:
            return loss_values, o.new_zeros(0)
        predicted = now + prediction.observation_change.float()
        grounded = seen_after if agent.config.impute_missing else seen_after * seen_now
        loss_values["grounding_loss"] = losses.grounding_loss(
            predicted, after, prediction.reward.float(), r, grounded, m
        )
        return loss_values, unexplained_change(predicted.detach() - now, after - now, m * seen_after * seen_now)

    def _autocast(self) -> AbstractContextManager[None]:
        return torch.autocast(self.agent.log_alpha.device.type, torch.bfloat16, enabled=self.bf16)

    def _to_bf16(self, z: Tensor) -> Tensor:
        """What all heads read, rounded once for all where their products are in bfloat16."""
        return z.bfloat16() if self.bf16 else z

    @torch.no_grad()
    def _unroll_target(self, o: Tensor, batch: Batch) -> MemoryOutput:
        return unroll(self.target_memory, o, batch, self.burn_in)

    def _noise_like(self, x: Tensor) -> Tensor:
        return torch.randn(x.shape, generator=self.generator, device=x.device)

    def _scaled(self, i: Tensor, m: Tensor) -> tuple[Tensor, Tensor]:
        """Curiosity in units of its running standard deviation, where configured, and its running variance."""
        if self.config.curiosity_scale == "raw":
            return i, self.curiosity_variance
        variance = losses.masked_mean((i - losses.masked_mean(i, m)).square(), m)
        moved = self.curiosity_variance.lerp(torch.stack([variance, torch.ones_like(variance)]), 0.01)
        running, weight = moved.unbind()
        return i / (running / weight).sqrt().clamp(min=1e-6), moved

    def _step(self, optimizer: torch.optim.Adam, loss_values: Iterable[Tensor]) -> Tensor:
        """Backward from the losses' sum, clip, Adam; returns the gradient's norm before clipping."""
        self.agent.zero_grad(set_to_none=True)
        sum(loss_values, torch.zeros_like(self.agent.log_alpha)).backward()  # type: ignore[no-untyped-call]
        gradients = [value.grad for value in self.agent.parameters() if value.grad is not None]
        norm = nn.utils.get_total_norm(gradients)
        if self.config.clip_norm:
            nn.utils.clip_grads_with_norm_(self.agent.parameters(), self.config.clip_norm, norm)
        optimizer.step()
        return norm.detach()

    def _follow(self, updated: UpdateResult) -> None:
        """What follows the step: targets by Polyak, and the running variance."""
        self._polyak(self.target_critic.parameters(), self.agent.critic.parameters())
        if self._has_target_memory:
            self._polyak(self.target_memory.parameters(), self.agent.memory.parameters())
        self.curiosity_variance.copy_(updated.curiosity_variance)

    @torch.no_grad()
    def _polyak(self, target: Iterable[Tensor], source: Iterable[Tensor]) -> None:
        torch._foreach_lerp_(list(target), list(source), 1.0 - self.config.polyak)

    @torch.no_grad()
    def update_ema(self, updates: int) -> None:
        """Move theta-bar of algorithm 1 towards what acts; every ``AVERAGE_UPDATES``, the last time at ``updates``."""
        over = min(self.config.policy_ema_updates, updates / 10) / AVERAGE_UPDATES
        torch._foreach_lerp_(list(self.average.values()), list(self.agent.acting().values()), 1.0 / max(1.0, over))

    def policy_weights(self) -> dict[str, Tensor]:
        """What checkpoints hold and evaluations play: theta-bar, with what normalises observations now."""
        averaged = self.average if self.config.policy_ema_updates else {}
        return self.agent.policy_weights() | {name: value.cpu() for name, value in averaged.items()}

    def state_dict(self) -> dict[str, Any]:
        """All that an update changes, for a checkpoint."""
        return {
            "agent": self.agent.state_dict(),
            "target_critic": self.target_critic.state_dict(),
            "target_memory": self.target_memory.state_dict(),
            "average": self.average,
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
            "curiosity_variance": self.curiosity_variance,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from ``state_dict``, bit for bit; with the step sizes of this run's config."""
        self.agent.load_state_dict(state["agent"])
        self.target_critic.load_state_dict(state["target_critic"])
        self.target_memory.load_state_dict(state["target_memory"])
        for name, value in self.average.items():
            value.copy_(state["average"][name])
        for optimizer, saved in zip(self.optimizers, state["optimizers"], strict=True):
            own = [{name: group[name] for name in ("lr", "capturable")} for group in optimizer.param_groups]
            optimizer.load_state_dict(saved)
            for group, ours in zip(optimizer.param_groups, own, strict=True):
                group.update(ours)  # of this config and this device, whatever wrote the checkpoint
        self.curiosity_variance.copy_(state["curiosity_variance"])
        self._resume_noise(state["generator"].cpu())

    def _resume_noise(self, state: Tensor) -> None:
        """Bit for bit on the kind of device that saved it, with other numbers on another."""
        if state.shape == self.generator.get_state().shape:
            self.generator.set_state(state)
        else:
            self.generator.manual_seed(zlib.crc32(state.numpy().tobytes()))


class AlternateUpdate(JointUpdate):
    """Algorithm 1 as printed: model, what fills, critics, policy, temperature in turn, each from a fresh forward.

    Each has an optimiser of its own, so that a memory that several losses train is moved by several.
    """

    _STAGES = (
        ("world_model", ("model_loss", "grounding_loss")),
        ("next_frame", ("fill_loss",)),
        ("critic", ("q_loss",)),
        ("policy", ("policy_loss",)),
        ("log_alpha", ("temperature_loss",)),
    )

    def _make_optimizers(self) -> list[torch.optim.Adam]:
        return [_adam(self.agent, self.config, "memory", part) for part, _ in self._stages()]

    def _stages(self) -> list[tuple[str, tuple[str, ...]]]:
        return [(part, names) for part, names in self._STAGES if getattr(self.agent, part) is not None]

    def __call__(self, batch: Batch, beta: Tensor) -> UpdateResult:
        """One round from a Batch. Each metric is from its own stage's forward; priorities from the critics'."""
        metrics: dict[str, Tensor] = {}
        norms = []
        for optimizer, (part, names) in zip(self.optimizers, self._stages(), strict=True):
            loss_values, stage = self.forward(batch, beta)
            stage_losses = {name: loss for name, loss in loss_values.items() if name in names}
            norms.append(self._step(optimizer, stage_losses.values()))
            metrics |= {name: stage.metrics[name] for name in stage_losses}
            if part == "critic":
                updated = stage
        self._follow(updated)
        return updated._replace(metrics=updated.metrics | metrics | {"grad_norm": torch.stack(norms).norm()})


def make_update(agent: Agent, burn_in: int, config: UpdateConfig, seed: int, bf16: bool = False) -> JointUpdate:
    """The update in the order that the config names."""
    kind = JointUpdate if config.update_order == "joint" else AlternateUpdate
    return kind(agent, burn_in, config, seed, bf16)


def _target_copy(module: ModuleT) -> ModuleT:
    """A copy for passes under no_grad. Its parameters still say requires_grad: else matmul batches and copies."""
    copied = copy.deepcopy(module)
    for part in copied.modules():
        if isinstance(part, nn.RNNBase):
            part.flatten_parameters()  # deepcopy scatters what cuDNN wants in one block
    return copied


def _adam(agent: Agent, config: UpdateConfig, *parts: str) -> torch.optim.Adam:
    """Adam for the parts of the agent that are named; memory and temperature have step sizes of their own."""
    heads = [part for part in parts if part not in ("memory", "log_alpha") and getattr(agent, part) is not None]
    groups = [
        {"params": list(agent.memory.parameters()), "lr": config.learning_rate * config.memory_learning_scale},
        {
            "params": [value for part in heads for value in getattr(agent, part).parameters()],
            "lr": config.learning_rate,
        },
        {"params": [agent.log_alpha] if "log_alpha" in parts else [], "lr": config.alpha_learning_rate},
    ]
    on_gpu = agent.log_alpha.device.type == "cuda"
    return torch.optim.Adam([group for group in groups if group["params"]], fused=True, capturable=on_gpu)


def _seen(batch: Batch) -> Tensor:
    """(B, T + 1) float: the observation is real, and not missing."""
    return (batch.observation_valid & ~batch.missing).float()
