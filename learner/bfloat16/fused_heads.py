"""Heads and critics of ``fused.py``: one node of the gradient's graph for all their layers.

Shapes: S nets side by side, N = B T rows, K units, Z head input, A action.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rmc.common.agent import Float32Linear
from rmc.common.critic import MOMENTUM, VARIANCE_EPS, BatchNorm, StackedLinear, TwinQ, shares
from rmc.learner.bfloat16 import kernels
from rmc.learner.bfloat16.rounded import BF16, Rounded, applies, bits


class FusedHead(Rounded, nn.Sequential):
    """Linear, ReLU, Linear, ReLU, Linear."""

    def weights(self) -> list[Tensor]:
        return [layer.weight for layer in self if isinstance(layer, nn.Linear) and not isinstance(layer, Float32Linear)]

    def forward(self, x: Tensor) -> Tensor:
        """(..., in) -> (..., out)."""
        if not applies(x):
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
        """(B, T, Z + P), (B, T, A) -> (2, B, T) in float32; given m (B, T), normalised by these steps."""
        if not applies(features):
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
            kernels.statistics(bits(x), self.share.numpy(), mean.numpy(), variance.numpy())
            for old, new in zip(running, (mean, variance), strict=True):
                old.lerp_(new, MOMENTUM)
        scale, normed = (variance + VARIANCE_EPS).rsqrt(), torch.empty_like(x)
        if layer.gain is None or layer.offset is None:
            kernels.normalize(bits(x), mean.numpy(), scale.numpy(), bits(normed))
            return _Normed(normed, normed, scale)
        out, gain, offset = torch.empty_like(x), layer.gain[net, 0].detach(), layer.offset[net, 0].detach()
        of_units = mean.numpy(), scale.numpy(), gain.numpy(), offset.numpy()
        kernels.normalize_scaled(bits(x), *of_units, bits(normed), bits(out))
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
            y = x
            for depth, biases in ((0, b1), (1, b2)):
                y = relu_layer(y, low[depth][net], biases[net])
                kept.append(y)
                if norm.layers:
                    read = norm(depth + 1, net, y)
                    y = read.out
                    kept += read
            _last_layer(y, low[2][net], b3[net], out[net])
        share = torch.zeros(len(x)) if norm.share is None else norm.share
        ctx.save_for_backward(x, share, *low, *kept)
        ctx.split, ctx.normed = features.shape[1], bool(norm.layers)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, share, w1, w2, w3, *kept = ctx.saved_tensors
        input_norm, kept = (kept[:2], kept[2:]) if ctx.normed else ([], kept)
        wants_features, wants_action, _, _, wants_weights, *_ = ctx.needs_input_grad
        # of the inputs only those asked for: where the policy maximises Q, that is the action alone
        columns = slice(0 if wants_features else ctx.split, x.shape[1] if wants_action else ctx.split)
        dx, gradients = torch.zeros_like(x[:, columns]), _Gradients.empty([w1, w2, w3], ctx.normed)
        size = len(kept) // (2 * len(w1))
        layers = [kept[begin : begin + size] for begin in range(0, len(kept), size)]
        for net, (first, second) in enumerate(zip(layers[::2], layers[1::2], strict=True)):
            own = gradients.of_net(net)
            d2 = _last_layer_back(grad[net], second[:2][-1], w3[net], own.weights[2], own.biases[2])
            _to_relu(d2, second, share, own.affine[2:], own.biases[1])
            d1 = torch.mm(d2, w2[net].t())
            _to_relu(d1, first, share, own.affine[:2], own.biases[0])
            if dx.shape[1]:
                dx.addmm_(d1, w1[net][columns].t())
            if wants_weights:
                _product(first[:2][-1], d2, own.weights[1])
                _product(x, d1, own.weights[0])
        if ctx.normed and dx.shape[1]:
            _normalize_back(dx, [part[..., columns].contiguous() for part in input_norm], share)
        of_features = dx[:, : ctx.split] if wants_features else None
        of_action = dx[:, ctx.split - x.shape[1] :] if wants_action else None
        of_parameters = gradients.in_order()
        return of_features, of_action, None, None, *(of_parameters if wants_weights else [None] * len(of_parameters))


class _Gradients(NamedTuple):
    """Of the parameters of all nets, or views of one's: filled on the way back, net by net."""

    weights: list[Tensor]  # (S, in, out) of each layer
    biases: list[Tensor]  # (S, out)
    affine: list[Tensor]  # gain and offset of the first hidden layer and of the second, (S, K), with batch norm

    @classmethod
    def empty(cls, weights: list[Tensor], normed: bool) -> "_Gradients":
        first, second, last = ((len(w), w.shape[2]) for w in weights)
        affine = [torch.empty(size) for size in (first, first, second, second)] if normed else []
        of_weights = [torch.empty_like(w, dtype=torch.float32) for w in weights]
        return cls(of_weights, [torch.zeros(size) for size in (first, second, last)], affine)

    def of_net(self, net: int) -> "_Gradients":
        return _Gradients(*([part[net] for part in parts] for parts in self))

    def in_order(self) -> list[Tensor]:
        """As ``_Heads`` takes the parameters."""
        return [part for pair in zip(self.weights, self.biases, strict=True) for part in pair] + self.affine


def _to_relu(d: Tensor, kept: list[Tensor], share: Tensor, affine: list[Tensor], db: Tensor) -> None:
    """d (N, K), the gradient of what a layer hands on, <- that before its ReLU; fills those of gain, offset and bias.

    ``kept`` is the ReLU's output and, with batch norm, the fields of the ``_Normed`` that was made of it.
    """
    relu, *normed = kept
    if normed:
        _normalize_back(d, normed[1:], share, affine)
    kernels.relu_back(bits(d), bits(relu), db.numpy())


def _normalize_back(grad: Tensor, normed: list[Tensor], share: Tensor, affine: list[Tensor] | None = None) -> None:
    """grad <- that of what was normalised into ``normed`` (and the scale); into the gain's and offset's own."""
    x, scale = normed
    of_gain, of_offset = affine or [torch.empty_like(scale) for _ in range(2)]
    kernels.normalize_back(bits(grad), bits(x), scale.numpy(), share.numpy(), of_gain.numpy(), of_offset.numpy())


def relu_layer(x: Tensor, w: Tensor, b: Tensor) -> Tensor:
    """ReLU(x w + b): (N, in), (in, out), (out,) -> (N, out) in bfloat16."""
    y = torch.mm(x, w)
    kernels.bias_relu(bits(y), b.detach().numpy())
    return y


def _last_layer(x: Tensor, w: Tensor, b: Tensor, out: Tensor) -> None:
    """out <- x w + b: (N, in), (in, out), (out,) -> (N, out); products in w's type."""
    if w.shape[1] == 1 and w.dtype == torch.float32:
        kernels.dot(bits(x), w.detach().numpy()[:, 0], b.detach().numpy(), out.numpy()[:, 0])
    else:
        torch.add(torch.mm(x.to(w.dtype), w), b, out=out)


def _last_layer_back(grad: Tensor, x: Tensor, w: Tensor, dw: Tensor, db: Tensor) -> Tensor:
    """The gradient of x, (N, in) in bfloat16; fills those of w and b. Products in w's type."""
    torch.sum(grad, 0, out=db)
    d = grad.to(w.dtype)
    _product(x.to(w.dtype), d, dw)
    return torch.mm(d, w.t()).to(BF16)


def _product(x: Tensor, d: Tensor, out: Tensor) -> None:
    """out <- x^T d, in out's own layout: a Linear's weight lies transposed."""
    out.copy_(torch.mm(x.t(), d) if out.is_contiguous() else torch.mm(d.t(), x).t())
