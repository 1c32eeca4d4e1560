"""The update in the order that the config names: all losses at once, or one after the other."""

import torch
from torch import Tensor

from rmc.common.agent import Agent
from rmc.learner.batch import Batch
from rmc.learner.config import UpdateConfig
from rmc.learner.optimizers import make_adam
from rmc.learner.update import JointUpdate, UpdateResult, detached


class AlternateUpdate(JointUpdate):
    """Algorithm 1 as printed: model, what fills, critics, policy, temperature in turn, each from a fresh forward.

    Each has an optimiser of its own, so that a memory that several losses train is moved by several. Each forward moves
    the running statistics of critics with batch norm. What has no turn in an update has no forward there.
    """

    _STAGES = (
        ("world_model", ("model_loss", "grounding_loss")),
        ("next_frame", ("fill_loss",)),
        ("critic", ("q_loss",)),
        ("policy", ("policy_loss",)),
        ("log_alpha", ("temperature_loss",)),
    )

    def _make_optimizers(self) -> list[torch.optim.Adam]:
        return [make_adam(self.agent, self.config, "memory", part) for part, _ in self._stages()]

    def _stages(self) -> list[tuple[str, tuple[str, ...]]]:
        return [(part, names) for part, names in self._STAGES if getattr(self.agent, part) is not None]

    def __call__(self, batch: Batch, beta: Tensor) -> UpdateResult:
        """One round from a Batch. Each loss is from its own stage's forward, all else from the critics'."""
        metrics: dict[str, Tensor] = {}
        norms = []
        turns = {"policy": batch.plan.trains_policy, "next_frame": batch.plan.trains_imputer}
        for optimizer, (part, names) in zip(self.optimizers, self._stages(), strict=True):
            if not turns.get(part, True):
                continue
            loss_values, model, actor_critic = self.forward(batch, beta)
            assert loss_values.keys() <= {name for _, stage in self._STAGES for name in stage}, "a loss without a stage"
            stage_losses = {name: loss for name, loss in loss_values.items() if name in names}
            norms.append(self.step([optimizer], stage_losses.values()))
            metrics |= detached(stage_losses)
            if part == "critic":
                of_critics = model, actor_critic
        model, actor_critic = of_critics
        actor_critic = actor_critic._replace(metrics=actor_critic.metrics | metrics)
        self.after_model_step(model)
        self.after_actor_critic_step()
        return self.result(batch, model, actor_critic, torch.stack(norms).norm())


def make_update(agent: Agent, config: UpdateConfig, seed: int, bf16: bool = False) -> JointUpdate:
    """The update in the order that the config names."""
    kind = JointUpdate if config.update_order == "joint" else AlternateUpdate
    return kind(agent, config, seed, bf16)
