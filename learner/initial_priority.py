"""The priority that a window enters the replay with, by the networks of the actor that made it.

The learner's own TD error (one-step or n-step, ``learner/losses.py``) and eta-mix, a' sampled from the policy at every
step. The critics as they were last broadcast take the targets' place; curiosity is left out. Handed to actors by
``deploy/``.
"""

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray

from rmc.common.agent import Agent, squashed_sample
from rmc.common.agent_config import AgentConfig
from rmc.common.critic import critic_input
from rmc.common.errors import MessageError
from rmc.common.window import Rows, WindowSpec
from rmc.learner import losses
from rmc.learner.batch import Plan, has_missing, longest_steps, view_batch
from rmc.learner.config import UpdateConfig
from rmc.learner.unroll import impute_and_unroll


class InitialPriority:
    """Rows in, priorities out; on the CPU."""

    def __init__(self, spec: WindowSpec, agent: AgentConfig, update: UpdateConfig) -> None:
        """``reseed`` and ``load`` must come first."""
        self._spec, self._update = spec, update
        self._agent = Agent(spec.obs_dim, spec.action_dim, agent, spec.missing, spec.privileged)
        self._generator = torch.Generator()

    def reseed(self, seed: int) -> None:
        """Of a' at every step."""
        self._generator.manual_seed(seed)

    def load(self, blob: bytes) -> None:
        """Take over what was broadcast, the safetensors of ``Agent.broadcast_weights()``. Raises MessageError."""
        try:
            weights = safetensors.torch.load(blob)
        except safetensors.SafetensorError as error:
            raise MessageError("weights", f"not of this run ({error})") from None
        mine = self._agent.broadcast_weights()
        for name in [*mine, *weights]:  # before any is taken, so that what is refused changes nothing
            given, own = weights.get(name), mine.get(name)
            if given is None or own is None or (given.shape, given.dtype) != (own.shape, own.dtype):
                raise MessageError("weights", f"not of this run ({name})")
            if not given.isfinite().all():
                raise MessageError("weights", f"{name} is not finite")
        self._agent.load_state_dict(weights, strict=False)

    @torch.no_grad()
    def __call__(self, rows: Rows) -> NDArray[np.float32]:
        """Windows (B,) -> (B,)."""
        raw = torch.from_numpy(rows.view("u1").reshape(len(rows), -1))
        plan = Plan(longest_steps(raw, self._spec), has_missing(raw, self._spec), False, False)
        batch = view_batch(raw, torch.ones(len(rows)), self._spec, plan)
        agent, steps = self._agent, batch.trained
        m = batch.step_valid[:, steps].float()
        o = agent.normalizer(batch.observation, batch.missing)
        z = agent.features(impute_and_unroll(agent, o, batch)[1])
        read = critic_input(z, agent.normalized_privileged(batch.privileged[:, steps]))
        mean, log_std = agent.policy(z)
        pi, log_pi = squashed_sample(mean, log_std, torch.randn(mean.shape, generator=self._generator))
        next_value = losses.soft_value(agent.critic(read[:, 1:], pi[:, 1:]), agent.log_alpha.exp(), log_pi[:, 1:])
        y = losses.td_target(
            batch.reward[:, steps], self._update.gamma, batch.terminated[:, steps], next_value, m, self._update.n_step
        )
        td_error = (agent.critic(read[:, :-1], batch.action[:, steps]) - y).abs().mean(0)
        priority: NDArray[np.float32] = losses.priority(td_error, self._update.eta, m).numpy()
        return priority
