"""The joint update: the losses whose turn it is, from the parameters as they stood; one step of each optimiser.

Shapes: B batch, L_b burn-in, L_t trained steps, O observation, A action, H hidden, S state, Z head input, M flags of
what is missing, P privileged.
z_t is what heads read: h_t, the paper's s_t, or o_t, or both, as configured.
Nothing here waits for the host: no ``.item()``, no branch on a tensor, static shapes.
"""

import copy
import zlib
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.func import functional_call

from rmc.common.agent import Agent, MemoryOutput, Prediction, squashed_sample
from rmc.common.critic import critic_input
from rmc.common.window import WindowSpec
from rmc.learner import losses
from rmc.learner.batch import Batch, Plan, has_missing, longest_steps
from rmc.learner.bfloat16.fused import fuse
from rmc.learner.config import UpdateConfig
from rmc.learner.diagnostics import actor_critic_metrics, model_metrics, unexplained_change
from rmc.learner.optimizers import by_optimizer, make_adam, polyak_update
from rmc.learner.policy_average import PolicyAverage
from rmc.learner.unroll import impute_and_unroll, unroll

ModuleT = TypeVar("ModuleT", bound=nn.Module)
MODEL_PARTS = ("memory", "world_model", "next_frame")
ACTOR_CRITIC_PARTS = ("critic", "policy", "log_alpha")
IMPUTER_UPDATES = 10  # for one of the imputer's, until a frame is missing: before that its output is unused
TRAINS_MEMORY = {  # the paper's table 1
    1: {"model", "value"},
    2: {"value"},
    3: {"model"},
    4: {"model", "value", "policy"},
    5: {"model", "policy"},
    6: {"value", "policy"},
}


class ModelPass(NamedTuple):
    """What memory and world model make of a batch, for critics, policy and temperature."""

    z: Tensor  # (B, L_t + 1, Z), what the heads read
    next_z: Tensor  # (B, L_t, Z), what the target reads, without gradient
    curiosity: Tensor  # (B, L_t), scaled where configured
    curiosity_variance: Tensor  # (2,), as it is after this batch
    hidden: Tensor  # (B, L_t + 1, H), for the latent's rank
    observation_unexplained: Tensor  # (O,), see ``diagnostics.unexplained_change``; (0,) without grounding
    metrics: dict[str, Tensor]  # scalars


class ActorCriticPass(NamedTuple):
    """What critics, policy and temperature make of it."""

    priorities: Tensor  # (B,)
    metrics: dict[str, Tensor]  # scalars


class UpdateResult(NamedTuple):
    """What an update gives back, all on the device and without gradient."""

    priorities: Tensor  # (B,)
    metrics: dict[str, Tensor]  # scalars
    hidden: Tensor  # (B, L_t + 1, H)
    observed: Tensor  # (B, L_t + 1) bool, which of them are real
    observation_unexplained: Tensor  # (O,)


Losses = dict[str, Tensor]


class JointUpdate:
    """Agent, targets where there are some, optimisers, and the update that moves them together."""

    def __init__(self, agent: Agent, config: UpdateConfig, seed: int, bf16: bool = False) -> None:
        device = agent.log_alpha.device
        if bf16 and device.type == "cpu":
            fuse(agent)
        self.agent, self.config, self.bf16 = agent, config, bf16
        self.target_critic = None if agent.config.critic_batch_norm else _target_copy(agent.critic)
        has_target = "ema" in (config.latent_target, config.target_memory)
        self.ema_memory = _target_copy(agent.memory) if has_target else None
        self.average = PolicyAverage(agent, config.policy_ema_updates)
        self.optimizers = self._make_optimizers()
        self.generator = torch.Generator(device).manual_seed(seed)
        self.curiosity_variance = torch.zeros(2, device=device)  # running mean, and the weight it has gathered
        self.was_missing = torch.zeros((), dtype=torch.bool)  # whether a frame ever was, on the host

    def _make_optimizers(self) -> list[torch.optim.Adam]:
        return [make_adam(self.agent, self.config, *parts) for parts in (MODEL_PARTS, ACTOR_CRITIC_PARTS)]

    def __call__(self, batch: Batch, beta: Tensor) -> UpdateResult:
        """One update from a Batch, in one step of all losses; ``beta`` is a scalar tensor."""
        loss_values, model, actor_critic = self.forward(batch, beta)
        norm = self.step(self.optimizers, loss_values.values())
        self.after_model_step(model)
        self.after_actor_critic_step()
        return self.result(batch, model, actor_critic, norm)

    def train_model(self, batch: Batch) -> tuple[ModelPass, Tensor]:
        """The half of memory and world model, where no other loss moves them, and its gradient's norm."""
        loss_values, model = self.model_pass(batch)
        norm = self.step(self.optimizers[:1], loss_values.values())
        self.after_model_step(model)
        return model, norm

    def train_actor_critic(self, batch: Batch, model: ModelPass, beta: Tensor) -> tuple[ActorCriticPass, Tensor]:
        """The other half, which moves critics, policy and temperature alone, and its gradient's norm."""
        loss_values, actor_critic = self.actor_critic_pass(batch, model, beta)
        norm = self.step(self.optimizers[1:], loss_values.values())
        self.after_actor_critic_step()
        return actor_critic, norm

    def forward(self, batch: Batch, beta: Tensor) -> tuple[Losses, ModelPass, ActorCriticPass]:
        """Every loss from the parameters as they stand, in the order of the paper's section 3."""
        model_losses, model = self.model_pass(batch)
        actor_critic_losses, actor_critic = self.actor_critic_pass(batch, model, beta)
        return model_losses | actor_critic_losses, model, actor_critic

    def model_pass(self, batch: Batch) -> tuple[Losses, ModelPass]:
        """Memory, prediction and curiosity; reads nothing of critics, policy and temperature."""
        agent, c = self.agent, self.config
        a, _, d, m = _trained(batch)
        with torch.no_grad():
            o = agent.normalizer(batch.observation, batch.missing)
        with self._autocast():
            # Memory: h_t from the stored state, burned in without gradient
            o, remembered = impute_and_unroll(agent, o, batch)
            z = self._to_bf16(agent.features(remembered))
            memories, read = {"online": remembered}, {"online": z}
            if self.ema_memory is not None:
                with torch.no_grad():
                    memories["ema"] = unroll(self.ema_memory, o, batch)
                    read["ema"] = self._to_bf16(agent.features(memories["ema"]))
            next_z = read[c.target_memory][:, 1:].detach()

            # Prediction of h_{t+1} - h_t, and curiosity from its error
            h = memories[c.latent_target].hidden.detach().float()
            change = h[:, 1:] - h[:, :-1]
            prediction = agent.world_model(self._for("model", z)[:, :-1], a)
            error = losses.model_error(prediction.hidden_change.float(), change, c.model_norm)
            i, curiosity_variance = self._scaled(losses.curiosity(error, d, m), m)
        o = o[:, batch.trained]
        imputer_loss = self._imputer_loss(o, remembered, batch, m)
        grounding_loss, unexplained = self._grounding_loss(o, prediction, batch, m)
        loss_values = {"model_loss": losses.model_loss(error, d, m)} | imputer_loss | grounding_loss

        # What is reported: nothing is learnt from it
        metrics = model_metrics(detached(loss_values), change, i, d, m, c.model_norm)
        hidden = remembered.hidden.detach()
        return loss_values, ModelPass(z, next_z, i, curiosity_variance, hidden, unexplained, metrics)

    def actor_critic_pass(self, batch: Batch, model: ModelPass, beta: Tensor) -> tuple[Losses, ActorCriticPass]:
        """Intuition: one policy sample for every step serves both the target and the policy loss."""
        agent, c, z = self.agent, self.config, model.z
        a, r, d, m = _trained(batch)
        privileged = agent.normalized_privileged(batch.privileged[:, batch.trained])
        alpha = agent.log_alpha.exp().detach()
        z_value, z_policy = self._for("value", z), self._for("policy", z)
        with self._autocast():
            # A sample of the policy at every h_t
            with torch.set_grad_enabled(batch.plan.trains_policy):
                mean, log_std = agent.policy(z_policy)
                pi, log_pi = squashed_sample(mean, log_std, self._noise_like(mean, batch.cut))

            # Q of (h_t, a_t), and its target from (h_{t+1}, a')
            taken = critic_input(z_value[:, :-1], privileged[:, :-1]), a
            following = critic_input(model.next_z, privileged[:, 1:]), pi[:, 1:].detach()
            q, next_q = self._values(taken, following, m)
            next_value = losses.soft_value(next_q, alpha, log_pi[:, 1:].detach())
            y = losses.td_target(r + beta * model.curiosity, c.gamma, d, next_value, m, c.n_step)

            # Q that the policy maximises
            z_actor = z_policy if c.policy_through_q else z.detach()
            proposed = critic_input(z_actor[:, :-1], privileged[:, :-1]), pi[:, :-1]

        log_pi, td_error = log_pi[:, :-1], (q.detach() - y).abs().mean(0)
        loss_values = {
            "q_loss": losses.q_loss(q, y, batch.importance, m),
            "temperature_loss": losses.temperature_loss(agent.log_alpha, log_pi, c.target_entropy * a.shape[-1], m),
        }
        if batch.plan.trains_policy:
            loss_values["policy_loss"] = losses.policy_loss(log_pi, self._frozen_q(*proposed), alpha, m)

        # What is reported: nothing is learnt from it
        metrics = actor_critic_metrics(
            detached(loss_values), alpha, log_pi.detach(), q.detach(), td_error, model.curiosity, r, m, beta
        )
        return loss_values, ActorCriticPass(losses.priority(td_error, c.eta, m), metrics)

    def _values(
        self, taken: tuple[Tensor, Tensor], following: tuple[Tensor, Tensor], m: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Q of what was taken, (h_t, a_t), and of what follows, (h_{t+1}, a'), without gradient: (2, B, L_t) each.

        The latter is the target critics'. With batch norm one pass gives both, and there are no targets (CrossQ, arXiv
        1902.05605).
        """
        if self.target_critic is not None:
            with torch.no_grad():
                next_q = self.target_critic(*following)
            return self.agent.critic(*taken), next_q
        both = (torch.cat(pair, dim=1) for pair in zip(taken, following, strict=True))
        q, next_q = self.agent.critic(*both, torch.cat([m, m], dim=1)).chunk(2, dim=2)
        return q, next_q.detach()

    def _frozen_q(self, read: Tensor, action: Tensor) -> Tensor:
        """(B, L_t) Q that the policy maximises, by parameters without gradient."""
        frozen = {name: value.detach() for name, value in self.agent.critic.named_parameters()}
        with self._autocast():
            q: Tensor = functional_call(self.agent.critic, frozen, (read, action))
        return q[0] if self.config.policy_q == "first" else q.min(0).values

    def result(self, batch: Batch, model: ModelPass, actor_critic: ActorCriticPass, norm: Tensor) -> UpdateResult:
        """What an update gives back of its passes; ``norm`` is the gradient's."""
        metrics = model.metrics | actor_critic.metrics | {"grad_norm": norm}
        observed = batch.observation_valid[:, batch.trained]
        return UpdateResult(actor_critic.priorities, metrics, model.hidden, observed, model.observation_unexplained)

    def plan(self, raw: Tensor, spec: WindowSpec, number: int) -> Plan:
        """Of update ``number``, from its (B, row bytes) on the host.

        A run's first is of whole windows, so that one too large for the machine ends early.
        The imputer trains at every ``IMPUTER_UPDATES``-th until a frame was missing, then at every one.
        """
        steps = spec.steps if number == 1 else longest_steps(raw, spec)
        trains_policy = number % self.config.policy_delay == 0
        if self.agent.next_frame is None:
            return Plan(steps, False, False, trains_policy)
        imputes = has_missing(raw, spec)
        self.was_missing |= imputes
        return Plan(steps, imputes, bool(self.was_missing) or number % IMPUTER_UPDATES == 0, trains_policy)

    def _imputer_loss(self, o: Tensor, remembered: MemoryOutput, batch: Batch, m: Tensor) -> Losses:
        """The imputer's, where it is configured and its turn; o (B, L_t + 1, O)."""
        imputer, now, after = self.agent.next_frame, o[:, :-1], o[:, 1:]
        if imputer is None or not batch.plan.trains_imputer:
            return {}
        with self._autocast():
            expected = imputer(self._to_bf16(remembered.hidden.detach()[:, :-1]), now, batch.action[:, batch.trained])
        return {"fill_loss": losses.observation_loss(expected, after, _seen(batch)[:, 1:], m)}

    def _grounding_loss(self, o: Tensor, prediction: Prediction, batch: Batch, m: Tensor) -> tuple[Losses, Tensor]:
        """Of predicted observations, o (B, L_t + 1, O), and rewards, where configured; what is left unexplained."""
        if not self.agent.config.grounding:
            return {}, o.new_zeros(0)
        r, seen, now, after = batch.reward[:, batch.trained], _seen(batch), o[:, :-1], o[:, 1:]
        predicted, both = now + prediction.observation_change.float(), seen[:, 1:] * seen[:, :-1]
        grounded = seen[:, 1:] if self.agent.config.impute_missing else both
        loss = losses.grounding_loss(predicted, after, prediction.reward.float(), r, grounded, m)
        unexplained = unexplained_change(predicted.detach() - now, after - now, m.unsqueeze(-1) * both)
        return {"grounding_loss": loss}, unexplained

    def _for(self, loss: str, z: Tensor) -> Tensor:
        """z as that loss reads it: its gradient reaches the memory where the scheme lets it (the paper's table 1)."""
        return z if loss in TRAINS_MEMORY[self.config.scheme] else z.detach()

    def _autocast(self) -> AbstractContextManager[None]:
        return torch.autocast(self.agent.log_alpha.device.type, torch.bfloat16, enabled=self.bf16)

    def _to_bf16(self, z: Tensor) -> Tensor:
        """What all heads read, rounded once for all where their products are in bfloat16."""
        return z.bfloat16() if self.bf16 else z

    def _noise_like(self, x: Tensor, cut: int) -> Tensor:
        """(B, L_t + 1, A) standard normal; also drawn for what is cut off: cut or not, a batch teaches the same."""
        rows, steps, size = x.shape
        return torch.randn(rows, steps + cut, size, generator=self.generator, device=x.device)[:, :steps]

    def _scaled(self, i: Tensor, m: Tensor) -> tuple[Tensor, Tensor]:
        """Curiosity in units of its running standard deviation, where configured, and its running variance."""
        if self.config.curiosity_scale == "raw":
            return i, self.curiosity_variance
        variance = losses.masked_mean((i - losses.masked_mean(i, m)).square(), m)
        moved = self.curiosity_variance.lerp(torch.stack([variance, torch.ones_like(variance)]), 0.01)
        running, weight = moved.unbind()
        return i / (running / weight).sqrt().clamp(min=1e-6), moved

    def step(self, optimizers: Sequence[torch.optim.Adam], loss_values: Iterable[Tensor]) -> Tensor:
        """Backward from the losses' sum, clip, Adam; returns the gradients' norm, before clipping."""
        parameters = [parameter for one in optimizers for group in one.param_groups for parameter in group["params"]]
        for parameter in parameters:
            parameter.grad = None
        sum(loss_values, torch.zeros_like(self.agent.log_alpha)).backward()  # type: ignore[no-untyped-call]
        gradients = [value.grad for value in parameters if value.grad is not None]
        norm = nn.utils.get_total_norm(gradients)
        if self.config.clip_norm:
            nn.utils.clip_grads_with_norm_(parameters, self.config.clip_norm, norm)
        for optimizer in optimizers:
            optimizer.step()
        return norm.detach()

    def after_model_step(self, model: ModelPass) -> None:
        """What follows the memory's step: its target by Polyak, the running variance."""
        if self.ema_memory is not None:
            polyak_update(self.ema_memory, self.agent.memory, 1.0 - self.config.polyak)
        self.curiosity_variance.copy_(model.curiosity_variance)

    def after_actor_critic_step(self) -> None:
        """What follows the critics' step: their targets by Polyak."""
        if self.target_critic is not None:
            polyak_update(self.target_critic, self.agent.critic, 1.0 - self.config.polyak)

    def state_dict(self) -> dict[str, Any]:
        """All that an update changes, for a checkpoint."""
        return {
            "agent": self.agent.state_dict(),
            "target_critic": self.target_critic.state_dict() if self.target_critic is not None else {},
            "target_memory": self.ema_memory.state_dict() if self.ema_memory is not None else {},
            "average": self.average.state_dict(),
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
            "curiosity_variance": self.curiosity_variance,
            "was_missing": self.was_missing,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from ``state_dict``, bit for bit; with the step sizes of this run's config."""
        self.agent.load_state_dict(state["agent"])
        if self.target_critic is not None:
            self.target_critic.load_state_dict(state["target_critic"])
        if self.ema_memory is not None:
            self.ema_memory.load_state_dict(state["target_memory"])
        self.average.load_state_dict(state["average"])
        for optimizer, saved in zip(self.optimizers, by_optimizer(state["optimizers"], self.optimizers), strict=True):
            own = [{name: group[name] for name in ("lr", "capturable")} for group in optimizer.param_groups]
            optimizer.load_state_dict(saved)
            for group, ours in zip(optimizer.param_groups, own, strict=True):
                group.update(ours)  # of this config and this device, whatever wrote the checkpoint
        self.curiosity_variance.copy_(state["curiosity_variance"])
        self.was_missing.copy_(state.get("was_missing", self.was_missing))  # older checkpoints have none
        self._resume_noise(state["generator"].cpu())

    def _resume_noise(self, state: Tensor) -> None:
        """Bit for bit on the kind of device that saved it, with other numbers on another."""
        if state.shape == self.generator.get_state().shape:
            self.generator.set_state(state)
        else:
            self.generator.manual_seed(zlib.crc32(state.numpy().tobytes()))


def _target_copy(module: ModuleT) -> ModuleT:
    """A copy for passes under no_grad. Its parameters still say requires_grad: else matmul batches and copies."""
    copied = copy.deepcopy(module)
    for part in copied.modules():
        if isinstance(part, nn.RNNBase):
            part.flatten_parameters()  # deepcopy scatters what cuDNN wants in one block
    return copied


def _trained(batch: Batch) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """a_t, r_t, d_t and the mask m_t of the trained steps: (B, L_t, A), (B, L_t) each."""
    steps = batch.trained
    return (
        batch.action[:, steps],
        batch.reward[:, steps],
        batch.terminated[:, steps],
        batch.step_valid[:, steps].float(),
    )


def detached(values: Losses) -> Losses:
    return {name: value.detach() for name, value in values.items()}


def _seen(batch: Batch) -> Tensor:
    """(B, L_t + 1, M) float: the observation is real, and not missing."""
    return (batch.observation_valid.unsqueeze(-1) & ~batch.missing)[:, batch.trained].float()
