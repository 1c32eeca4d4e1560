"""The networks as fast as a CPU with bfloat16 products takes them: the same parameters, the same equations.

``fuse`` swaps the GRU and the heads of an Agent for these. Under bfloat16 autocast each is one node of the gradient's
graph: products by torch, all between them by ``learner/kernels.py``, weight gradients in one product over all steps.
Weights are rounded once an update, not once a product.
Without autocast, and on a GPU, they are what they were. Shapes: B batch, T time, N = B T, S nets side by side.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rmc.common.agent import Agent, Float32Linear
from rmc.common.agent_config import NORMALIZED_CLIP
from rmc.common.critic import STATISTICS_SHARE, VARIANCE_FLOOR, BatchNorm, StackedLinear, TwinQ, shares
from rmc.learner import kernels

BF16 = torch.bfloat16
ModuleT = TypeVar("ModuleT", bound=nn.Module)


def fuse(agent: Agent) -> None:
    """Swap an agent's class and parts in place; parameters and their names stay."""
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


def _applies(x: Tensor) -> bool:
    return x.device.type == "cpu" and torch.is_autocast_enabled("cpu") and torch.get_autocast_dtype("cpu") is BF16


class Rounded(nn.Module):
    """A module that keeps its weights in bfloat16, too, rounded again where one was written since.

    That is seen by torch's version of it, which neither ``.data`` nor numba raises: ``CompiledAdam`` rounds itself.
    """

    def weights(self) -> list[Tensor]:
        """Those that products in bfloat16 read."""
        raise NotImplementedError

    def bf16(self) -> list[Tensor]:
        """The bfloat16 copies, always in the same memory."""
        weights, state = self.weights(), self.__dict__
        versions = [weight._version for weight in weights]
        if "_rounded" not in state:
            state["_rounded"] = [torch.empty_like(weight, dtype=BF16) for weight in weights]
        if state.get("_versions") != versions:
            for low, weight in zip(state["_rounded"], weights, strict=True):
                low.copy_(weight.detach())
            state["_versions"] = versions
        rounded: list[Tensor] = state["_rounded"]
        return rounded


def rounded_weights(modules: Iterable[nn.Module]) -> dict[Tensor, Tensor]:
    """By weight, its bfloat16 copy, of all modules that have some."""
    parts = [part for module in modules for part in module.modules() if isinstance(part, Rounded)]
    return {weight: low for part in parts for weight, low in zip(part.weights(), part.bf16(), strict=True)}


class FusedAgent(Agent):
    """Fills missing frames with every weight rounded once for all steps, not once a step."""

    @torch.no_grad()
    def fill(self, observation: Tensor, missing: Tensor, prev_action: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """As ``Agent.fill``, which it is without a memory, or where the embedding has no plain layer."""
        c = self.config
        if not (c.embedding and _applies(observation)) or c.layer_norm or c.head_input == "observation":
            return super().fill(observation, missing, prev_action, state)
        with torch.autocast("cpu", enabled=False):
            return _fill(self, observation, missing, prev_action, state)


class FusedGRU(Rounded, nn.GRU):
    """One layer, batch first."""

    def weights(self) -> list[Tensor]:
        input_weight, recurrent_weight = self.all_weights[0][:2]
        return [input_weight, recurrent_weight]

    def forward(self, x: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        """(B, T, E), (1, B, H) -> (B, T, H) and (1, B, H)."""
        if not _applies(x):
            plain: tuple[Tensor, Tensor] = super().forward(x, hidden)
            return plain
        with torch.autocast("cpu", enabled=False):
            sequence: Tensor = _GRU.apply(  # type: ignore[no-untyped-call]
                x, hidden[0], self.bf16(), self.weight_ih_l0, self.weight_hh_l0, self.bias_ih_l0, self.bias_hh_l0
            )
        return sequence, sequence[:, -1].unsqueeze(0)


class FusedHead(Rounded, nn.Sequential):
    """Linear, ReLU, Linear, ReLU, Linear."""

    def weights(self) -> list[Tensor]:
        return [layer.weight for layer in self if isinstance(layer, nn.Linear) and not isinstance(layer, Float32Linear)]

    def forward(self, x: Tensor) -> Tensor:
        """(..., in) -> (..., out)."""
        if not _applies(x):
            plain: Tensor = super().forward(x)  # type: ignore[no-untyped-call]
            return plain
        layers = [layer for layer in self if isinstance(layer, nn.Linear)]
        parameters = [part for one in layers for part in (one.weight.t().unsqueeze(0), one.bias.unsqueeze(0))]
        low = [weight.t().unsqueeze(0) for weight in self.bf16()]
        return _heads(x, x.new_empty(*x.shape[:-1], 0), low, parameters)[0]


class FusedTwinQ(Rounded, TwinQ):
    """Both critics."""

    def weights(self) -> list[Tensor]:
        return [layer.weight for layer in self.layers[:-1] if isinstance(layer, StackedLinear)]

    def forward(self, features: Tensor, action: Tensor, m: Tensor | None = None) -> Tensor:
        """(B, T, Z), (B, T, A) -> (2, B, T) in float32; given m (B, T), normalised by these steps."""
        if not _applies(features):
            return super().forward(features, action, m)
        stacks = [layer for layer in self.layers if isinstance(layer, StackedLinear)]
        parameters = [part for one in stacks for part in (one.weight, one.bias[:, 0])]
        norm = _Norm([norm for norm in self.norms if isinstance(norm, BatchNorm)], None if m is None else shares(m))
        parameters += [part[:, 0] for one in norm.layers for part in (one.gain, one.offset) if part is not None]
        return _heads(features, action, self.bf16(), parameters, norm).squeeze(-1)


class _Norm(NamedTuple):
    """Batch norm of the input and of both hidden layers, or of nothing."""

    layers: list[BatchNorm]
    share: Tensor | None = None  # (N,) of each row in the statistics, which then move the running ones

    def __call__(self, depth: int, net: int, x: Tensor) -> "_Normed":
        """(N, K) in bfloat16."""
        layer = self.layers[depth]
        mean, variance = running = layer.mean[net, 0], layer.variance[net, 0]
        if self.share is not None:
            mean, variance = torch.empty_like(mean), torch.empty_like(variance)
            kernels.statistics(_bits(x), self.share.numpy(), mean.numpy(), variance.numpy())
            for old, new in zip(running, (mean, variance), strict=True):
                old.lerp_(new, STATISTICS_SHARE)
        scale, normed = (variance + VARIANCE_FLOOR).rsqrt(), torch.empty_like(x)
        if layer.gain is None or layer.offset is None:
            kernels.normalize(_bits(x), mean.numpy(), scale.numpy(), _bits(normed))
            return _Normed(normed, normed, scale)
        out, gain, offset = torch.empty_like(x), layer.gain[net, 0].detach(), layer.offset[net, 0].detach()
        of_units = mean.numpy(), scale.numpy(), gain.numpy(), offset.numpy()
        kernels.normalize_scaled(_bits(x), *of_units, _bits(normed), _bits(out))
        return _Normed(out, normed, scale * gain)


class _Normed(NamedTuple):
    """What became of (N, K), and what the way back takes."""

    out: Tensor
    normed: Tensor  # without gain and offset
    scale: Tensor  # (K,), with the gain


def _heads(
    features: Tensor, action: Tensor, low: list[Tensor], parameters: list[Tensor], norm: _Norm | None = None
) -> Tensor:
    """(..., Z), (..., A) -> (S, ..., out)."""
    flat = (x.flatten(0, -2) for x in (features, action))
    with torch.autocast("cpu", enabled=False):
        out: Tensor = _Heads.apply(*flat, low, norm or _Norm([]), *parameters)  # type: ignore[no-untyped-call]
    return out.reshape(out.shape[0], *features.shape[:-1], out.shape[-1])


def _bits(x: Tensor) -> NDArray[np.uint16]:
    bits: NDArray[np.uint16] = x.view(torch.uint16).numpy()
    return bits


def _fill(
    agent: Agent, observation: Tensor, missing: Tensor, prev_action: Tensor, state: Tensor
) -> tuple[Tensor, Tensor]:
    """(B, T, O), (B, T, M), (B, T, A), (B, S) -> (B, T, O), (B, S)."""
    assert agent.next_frame is not None
    gru, size = agent.memory.gru, agent.config.hidden
    nets = agent.next_frame.net, agent.memory.embed
    linear = [layer for net in nets for layer in net if isinstance(layer, nn.Linear)]
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
    seen, before = observation.clone(), state[:, size:]
    by_step = (x.transpose(0, 1) for x in (seen, missing, prev_action.to(BF16), inputs))
    for o, was_missing, a, x in zip(*by_step, strict=True):
        second = _layer(_layer(torch.cat([low, before.to(BF16), a], 1), w1, b1), w2, b2)
        expected = torch.mm(second, w3).float().add_(b3).add_(before)
        torch.where(was_missing, expected.clamp_(-NORMALIZED_CLIP, NORMALIZED_CLIP), o, out=o)
        x[:, : agent.obs_dim] = o
        gi, gh = torch.mm(_layer(x.contiguous(), w_embed, b_embed), wi), torch.mm(low, wh)
        kernels.gru_step(_bits(gi), _bits(gh), bi, bh, h, gate_cache, h, _bits(low))
        before = o
    return seen, torch.cat([torch.from_numpy(h), before], 1)


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
        of_h, all_h, low, wh_t = _bits(gh), states.numpy(), _bits(states_low), wh.t()
        biases = bi.detach().numpy(), bh.detach().numpy()
        by_step = states_low[:-1].unbind(0), _bits(gi), all_h[:-1], gate_cache.numpy(), all_h[1:], low[1:]
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
        grad_state, by_product, biases = d.numpy(), _bits(grad_recurrent), (dbi.numpy(), dbn.numpy())
        by_step = grads.numpy(), states[:-1].numpy(), gate_cache.numpy(), _bits(dgi), _bits(dgh)
        backwards = zip(*(array[::-1] for array in by_step), reversed(dgh.unbind(0)), strict=True)
        for out, h_before, gates, of_i, of_h, d_gates in backwards:
            kernels.gru_step_back(grad_state, by_product, out, h_before, gates, of_i, of_h, *biases)
            torch.mm(d_gates, wh, out=grad_recurrent)
        flat_i, flat_h = dgi.view(t * b, 3 * h), dgh.view(t * b, 3 * h)
        dx = torch.mm(flat_i, wi).view(t, b, -1).transpose(0, 1) if ctx.needs_input_grad[0] else None
        dwi, dwh = torch.mm(flat_i.t(), x_low).float(), torch.mm(flat_h.t(), states_low[:-1].view(t * b, h)).float()
        return dx, d + grad_recurrent, None, dwi, dwh, dbi, torch.cat([dbi[: 2 * h], dbn])


class _Heads(torch.autograd.Function):
    """S nets that read the same (N, Z) and (N, A): weights (S, in, out), biases (S, out) -> (S, N, out) float32.

    ``rounded`` has the weights in bfloat16, but for a last layer whose products are in float32. With batch norm, gains
    and offsets (S, K) of both hidden layers stand behind them.
    """

    @staticmethod
    def forward(
        ctx: Any, features: Tensor, action: Tensor, rounded: list[Tensor], norm: _Norm, *parameters: Tensor
    ) -> Tensor:
        w1, b1, _, b2, w3, b3, *_ = parameters
        x = torch.cat([features.to(BF16), action.to(BF16)], dim=1)
        low = rounded if len(rounded) == 3 else [*rounded, w3]  # the last layer's products may be in float32
        kept: list[Tensor] = []
        if norm.layers:
            read = norm(0, 0, x)
            x, kept = read.out, [read.normed, read.scale]
        out = torch.empty(w1.shape[0], len(x), w3.shape[2])
        for net in range(w1.shape[0]):
            layer = x
            for depth, biases in ((0, b1), (1, b2)):
                layer = _layer(layer, low[depth][net], biases[net])
                kept.append(layer)
                if norm.layers:
                    read = norm(depth + 1, net, layer)
                    layer = read.out
                    kept += read
            _last_layer(layer, low[2][net], b3[net], out[net])
        share = torch.zeros(len(x)) if norm.share is None else norm.share
        ctx.save_for_backward(x, share, *low, *kept)
        ctx.split, ctx.normed = features.shape[1], bool(norm.layers)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, share, w1, w2, w3, *kept = ctx.saved_tensors
        input_norm, kept = (kept[:2], kept[2:]) if ctx.normed else ([], kept)
        weight_grads = [torch.empty_like(w, dtype=torch.float32) for w in (w1, w2, w3)]
        biases = [torch.zeros(w.shape[0], w.shape[2]) for w in (w1, w2, w3)]
        affine = [torch.empty(w.shape[0], w.shape[2]) for w in (w1, w1, w2, w2)] if ctx.normed else []
        wants_features, wants_action, _, _, wants_weights, *_ = ctx.needs_input_grad
        # of the inputs only those asked for: where the policy climbs Q, that is the action alone
        columns = slice(0 if wants_features else ctx.split, x.shape[1] if wants_action else ctx.split)
        dx, size = torch.zeros_like(x[:, columns]), len(kept) // w1.shape[0]
        for net in range(w1.shape[0]):
            layers = kept[size * net : size * (net + 1)]
            (first, *normed1), (second, *normed2) = layers[: size // 2], layers[size // 2 :]
            if ctx.normed:
                d2 = _normed_last_layer_back(grad[net], normed2[0], w3[net], weight_grads[2][net], biases[2][net])
                _normalize_back(d2, normed2[1:], share, [part[net] for part in affine[2:]])
                kernels.relu_back(_bits(d2), _bits(second), biases[1][net].numpy())
            else:
                d2 = _last_layer_back(grad[net], second, w3[net], weight_grads[2][net], biases[2][net], biases[1][net])
            d1 = torch.mm(d2, w2[net].t())
            if ctx.normed:
                _normalize_back(d1, normed1[1:], share, [part[net] for part in affine[:2]])
            kernels.relu_back(_bits(d1), _bits(first), biases[0][net].numpy())
            if dx.shape[1]:
                dx.addmm_(d1, w1[net][columns].t())
            if wants_weights:
                _product(normed1[0] if ctx.normed else first, d2, weight_grads[1][net])
                _product(x, d1, weight_grads[0][net])
        if ctx.normed and dx.shape[1]:
            _normalize_back(dx, [part[..., columns].contiguous() for part in input_norm], share)
        of_features = dx[:, : ctx.split] if wants_features else None
        of_action = dx[:, ctx.split - x.shape[1] :] if wants_action else None
        of_weights = [part for pair in zip(weight_grads, biases, strict=True) for part in pair] + affine
        return of_features, of_action, None, None, *(of_weights if wants_weights else [None] * len(of_weights))


def _normalize_back(grad: Tensor, normed: list[Tensor], share: Tensor, affine: list[Tensor] | None = None) -> None:
    """grad <- that of what was normalised into ``normed`` (and the scale); into the gain's and offset's own."""
    x, scale = normed
    of_gain, of_offset = affine or [torch.empty_like(scale) for _ in range(2)]
    kernels.normalize_back(_bits(grad), _bits(x), scale.numpy(), share.numpy(), of_gain.numpy(), of_offset.numpy())


def _normed_last_layer_back(grad: Tensor, x: Tensor, w: Tensor, dw: Tensor, db: Tensor) -> Tensor:
    """The gradient of x, (N, in) in bfloat16; fills those of w (in, 1) and b (1,)."""
    torch.sum(grad, 0, out=db)
    torch.mm(x.float().t(), grad, out=dw)
    return torch.mm(grad, w.t()).to(BF16)


def _layer(x: Tensor, w: Tensor, b: Tensor) -> Tensor:
    """ReLU(x w + b): (N, in), (in, out), (out,) -> (N, out) in bfloat16."""
    y = torch.mm(x, w)
    kernels.bias_relu(_bits(y), b.detach().numpy())
    return y


def _last_layer(x: Tensor, w: Tensor, b: Tensor, out: Tensor) -> None:
    """out <- x w + b: (N, in), (in, out), (out,) -> (N, out); products in w's type."""
    if w.shape[1] == 1:
        kernels.dot(_bits(x), w.detach().numpy()[:, 0], b.detach().numpy(), out.numpy()[:, 0])
    else:
        torch.add(torch.mm(x.to(w.dtype), w), b, out=out)


def _last_layer_back(grad: Tensor, x: Tensor, w: Tensor, dw: Tensor, db: Tensor, db_before: Tensor) -> Tensor:
    """The gradient before the ReLU that gave x, (N, in) in bfloat16; fills those of w, b and of the bias before."""
    torch.sum(grad, 0, out=db)
    if w.shape[1] == 1:
        back = torch.empty_like(x)
        of_w, of_x = w.detach().numpy()[:, 0], _bits(x)
        kernels.dot_back(grad.numpy()[:, 0], of_x, of_w, _bits(back), dw.numpy()[:, 0], db_before.numpy())
        return back
    d = grad.to(w.dtype)
    _product(x.to(w.dtype), d, dw)
    back = torch.mm(d, w.t()).to(BF16)
    kernels.relu_back(_bits(back), _bits(x), db_before.numpy())
    return back


def _product(x: Tensor, d: Tensor, out: Tensor) -> None:
    """out <- x^T d, in out's own layout: a Linear's weight lies transposed."""
    out.copy_(torch.mm(x.t(), d) if out.is_contiguous() else torch.mm(d.t(), x).t())
