"""The networks as fast as a CPU with bfloat16 products takes them: the same parameters, the same equations.

``fuse`` swaps the GRU and the heads of an Agent for these. Under bfloat16 autocast each is one node of the gradient's
graph: products by torch, all between them by ``kernels.py`` here, weight gradients in one product over all steps.
Without autocast, and on a GPU, they are what they were. Shapes: B batch, T time.
"""

from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rmc.common.agent import Agent, Float32Linear
from rmc.common.agent_config import NORMALIZED_CLIP
from rmc.learner.bfloat16 import kernels
from rmc.learner.bfloat16.fused_heads import FusedHead, FusedTwinQ, relu_layer
from rmc.learner.bfloat16.rounded import BF16, Rounded, applies, bits

ModuleT = TypeVar("ModuleT", bound=nn.Module)


def fuse(agent: Agent) -> None:
    """Swap an agent's class and parts in place; parameters and their names stay. All know ReLU alone."""
    nets = (agent.memory.embed, agent.world_model.net, agent.policy.net, getattr(agent.next_frame, "net", ()))
    assert {type(layer) for net in nets for layer in net} <= {nn.Linear, Float32Linear, nn.ReLU}
    agent.__class__ = FusedAgent
    agent.memory.gru = _as(FusedGRU, agent.memory.gru)
    agent.world_model.net = _as(FusedHead, agent.world_model.net)
    if agent.next_frame is not None:
        agent.next_frame.net = _as(FusedHead, agent.next_frame.net)
    agent.policy.net = _as(FusedHead, agent.policy.net)
    agent.critic = _as(FusedTwinQ, agent.critic)


def _as(kind: type[ModuleT], module: nn.Module) -> ModuleT:
    """The same object's contents under another class, which adds nothing to them."""
    fused = kind.__new__(kind)
    fused.__dict__.update(module.__dict__)
    return fused


class FusedAgent(Agent):
    """Fills missing frames with every weight rounded once for all steps, not once a step."""

    @torch.no_grad()
    def impute(self, observation: Tensor, missing: Tensor, prev_action: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """As ``Agent.impute``, which it is without a memory or an embedding."""
        c = self.config
        if not (c.embedding and applies(observation)) or c.head_input == "observation":
            return super().impute(observation, missing, prev_action, state)
        with torch.autocast("cpu", enabled=False):
            return _impute(self, observation, missing, prev_action, state)


class FusedGRU(Rounded, nn.GRU):
    """One layer, batch first."""

    def weights(self) -> list[Tensor]:
        input_weight, recurrent_weight = self.all_weights[0][:2]
        return [input_weight, recurrent_weight]

    def forward(self, x: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        """(B, T, E), (1, B, H) -> (B, T, H) and (1, B, H)."""
        if not applies(x):
            plain: tuple[Tensor, Tensor] = super().forward(x, hidden)
            return plain
        with torch.autocast("cpu", enabled=False):
            sequence: Tensor = _GRU.apply(  # type: ignore[no-untyped-call]
                x, hidden[0], self.bf16(), self.weight_ih_l0, self.weight_hh_l0, self.bias_ih_l0, self.bias_hh_l0
            )
        return sequence, sequence[:, -1].unsqueeze(0)


def _impute(
    agent: Agent, observation: Tensor, missing: Tensor, prev_action: Tensor, state: Tensor
) -> tuple[Tensor, Tensor]:
    """(B, T, O), (B, T, M), (B, T, A), (B, S) -> (B, T, O), (B, S)."""
    assert agent.next_frame is not None
    gru, size = agent.memory.gru, agent.config.hidden
    nets = agent.next_frame.net, agent.memory.embed
    linear = [one for net in nets for one in net if isinstance(one, nn.Linear)]
    assert isinstance(nets[0], Rounded)
    assert isinstance(gru, Rounded)
    w1, w2, w3, w_embed, wi, wh = (w.t() for w in (*nets[0].bf16(), linear[-1].weight.to(BF16), *gru.bf16()))
    b1, b2, b3, b_embed = (x.bias for x in linear)
    bi, bh = (b.numpy() for b in gru.all_weights[0][2:])
    inputs = agent.memory.inputs(observation, missing, prev_action).to(BF16)
    h, low, gate_cache = (
        state[:, :size].clone().numpy(),
        state[:, :size].to(BF16),
        np.empty((len(state), 4 * size), np.float32),
    )
    filled, before = observation.clone(), state[:, size:]
    by_step = (x.transpose(0, 1) for x in (filled, missing, prev_action.to(BF16), inputs))
    for o, was_missing, a, x in zip(*by_step, strict=True):
        if was_missing.any():
            second = relu_layer(relu_layer(torch.cat([low, before.to(BF16), a], 1), w1, b1), w2, b2)
            expected = torch.mm(second, w3).float().add_(b3).add_(before).clamp_(-NORMALIZED_CLIP, NORMALIZED_CLIP)
            torch.where(was_missing, expected.mul_((before != 0).any(1, keepdim=True)), o, out=o)
        x[:, : agent.obs_dim] = o
        gi, gh = torch.mm(relu_layer(x.contiguous(), w_embed, b_embed), wi), torch.mm(low, wh)
        kernels.gru_step(bits(gi), bits(gh), bi, bh, h, gate_cache, h, bits(low))
        before = o
    return filled, torch.cat([torch.from_numpy(h), before], 1)


class _GRU(torch.autograd.Function):
    """h_t for all t, and the way back through time."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, hidden: Tensor, rounded: list[Tensor], _wi: Tensor, _wh: Tensor, bi: Tensor, bh: Tensor
    ) -> Tensor:
        (b, t, e), h, (wi, wh) = x.shape, hidden.shape[1], rounded
        x_low = x.to(BF16).transpose(0, 1).reshape(t * b, e)
        gi, gh = torch.mm(x_low, wi.t()).view(t, b, 3 * h), torch.empty(b, 3 * h, dtype=BF16)
        states, gate_cache = torch.empty(t + 1, b, h), torch.empty(t, b, 4 * h)
        states_low = torch.empty(t + 1, b, h, dtype=BF16)
        states[0], states_low[0] = hidden, hidden
        of_h, all_h, low, wh_t = bits(gh), states.numpy(), bits(states_low), wh.t()
        biases = bi.detach().numpy(), bh.detach().numpy()
        by_step = states_low[:-1].unbind(0), bits(gi), all_h[:-1], gate_cache.numpy(), all_h[1:], low[1:]
        for before, of_x, h_before, gates, h_after, low_after in zip(*by_step, strict=True):
            torch.mm(before, wh_t, out=gh)
            kernels.gru_step(of_x, of_h, *biases, h_before, gates, h_after, low_after)
        ctx.save_for_backward(x_low, wi, wh, states, states_low, gate_cache)
        return states[1:].transpose(0, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x_low, wi, wh, states, states_low, gate_cache = ctx.saved_tensors
        t, b, h = gate_cache.shape[0], gate_cache.shape[1], states.shape[2]
        grads, d = grad.float().transpose(0, 1).contiguous(), torch.zeros(b, h)
        grad_recurrent = torch.zeros(b, h, dtype=BF16)
        dgi, dgh = torch.empty(t, b, 3 * h, dtype=BF16), torch.empty(t, b, 3 * h, dtype=BF16)
        dbi, dbn = torch.zeros(3 * h), torch.zeros(h)
        grad_state, by_product, biases = d.numpy(), bits(grad_recurrent), (dbi.numpy(), dbn.numpy())
        by_step = grads.numpy(), states[:-1].numpy(), gate_cache.numpy(), bits(dgi), bits(dgh)
        backwards = zip(*(array[::-1] for array in by_step), reversed(dgh.unbind(0)), strict=True)
        for out, h_before, gates, of_i, of_h, d_gates in backwards:
            kernels.gru_step_back(grad_state, by_product, out, h_before, gates, of_i, of_h, *biases)
            torch.mm(d_gates, wh, out=grad_recurrent)
        flat_i, flat_h = dgi.view(t * b, 3 * h), dgh.view(t * b, 3 * h)
        dx = torch.mm(flat_i, wi).view(t, b, -1).transpose(0, 1) if ctx.needs_input_grad[0] else None
        dwi, dwh = torch.mm(flat_i.t(), x_low).float(), torch.mm(flat_h.t(), states_low[:-1].view(t * b, h)).float()
        return dx, d + grad_recurrent, None, dwi, dwh, dbi, torch.cat([dbi[: 2 * h], dbn])
