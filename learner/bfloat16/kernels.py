"""What lies between a network's products in bfloat16 on a CPU, each in one pass over memory, compiled by numba.

bfloat16 is the upper half of a float32, handed over as uint16. Sums are in float32. NaN stays NaN everywhere,
but for odd payloads: see ``_down``.
Shapes: B rows, H units of a GRU, N rows and K units of a head's layer.
"""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rmc.common.compiled import compiled
from rmc.common.window import Floats

Bits = NDArray[np.uint16]  # bfloat16
FunctionT = TypeVar("FunctionT", bound=Callable[..., object])
ONE, TWO, HALF = np.float32(1.0), np.float32(2.0), np.float32(0.5)
EXP_RANGE = np.float32(87.0)  # beyond it float32 overflows
LOG2_E, LN_2 = np.float32(1.0 / np.log(2.0)), np.float32(np.log(2.0))
TAYLOR = tuple(np.float32(x) for x in (1 / 720, 1 / 120, 1 / 24, 1 / 6, 1 / 2, 1.0, 1.0))  # of exp
BLOCK = 1024  # elements that several loops pass over while they are in the first cache
FAST = {"contract", "reassoc", "nsz", "arcp"}  # all of fastmath but the promise that nothing is NaN or infinite


def _compiled(function: FunctionT) -> FunctionT:
    return compiled(function, FAST)


@_compiled
def _up(bits: np.uint16) -> np.float32:
    return np.int32(np.int32(bits) << np.int32(16)).view(np.float32)


@_compiled
def _down(x: np.float32) -> np.uint16:
    """Rounded to the nearest, ties to even.

    A NaN whose payload no arithmetic makes, like 0x7fffffff, may become a number: looking for it costs up to a fifth.
    """
    bits = np.float32(x).view(np.uint32)
    return np.uint16((bits + np.uint32(0x7FFF) + ((bits >> np.uint32(16)) & np.uint32(1))) >> np.uint32(16))


@_compiled
def _exp(x: np.float32) -> np.float32:
    """To 5e-7 of itself: 2^k times the series on the rest; libm's has no vector form here."""
    x = -EXP_RANGE if x < -EXP_RANGE else x
    x = EXP_RANGE if x > EXP_RANGE else x
    k = np.floor(x * LOG2_E + HALF)
    rest, series = x - k * LN_2, TAYLOR[0]
    for i in range(1, 7):
        series = series * rest + TAYLOR[i]
    return series * np.int32((np.int32(k) + np.int32(127)) << np.int32(23)).view(np.float32)


@_compiled
def _sigmoid(x: np.float32) -> np.float32:
    return ONE / (ONE + _exp(-x))


@_compiled
def lower(x: Floats, out: Bits) -> None:
    """out <- x in bfloat16; (K,) each."""
    for j in range(x.size):
        out[j] = _down(x[j])


@_compiled
def gru_step(
    gi: Bits, gh: Bits, bi: Floats, bh: Floats, h: Floats, gate_cache: Floats, new: Floats, new_bf16: Bits
) -> None:
    """h' = n + z (h - n) from the products gi = W_i x and gh = W_h h, (B, 3H) in nn.GRU's order r, z, n.

    ``gate_cache`` (B, 4H): r, z, n and W_hn h + b_hn, for the way back.
    Each loop is over few arrays, or it has no vector form.
    """
    size = h.shape[1]
    for b in range(h.shape[0]):
        gates, n, m = gate_cache[b, : 2 * size], gate_cache[b, 2 * size : 3 * size], gate_cache[b, 3 * size :]
        for j in range(2 * size):
            gates[j] = _sigmoid(_up(gi[b, j]) + bi[j] + (_up(gh[b, j]) + bh[j]))
        for j in range(size):
            m[j] = _up(gh[b, 2 * size + j]) + bh[2 * size + j]
        for j in range(size):
            n[j] = _up(gi[b, 2 * size + j]) + bi[2 * size + j] + gates[j] * m[j]
        for j in range(size):
            n[j] = TWO * _sigmoid(TWO * n[j]) - ONE  # tanh
        for j in range(size):
            new[b, j] = n[j] + gates[size + j] * (h[b, j] - n[j])
        lower(new[b], new_bf16[b])


@_compiled
def gru_step_back(
    d: Floats, grad_recurrent: Bits, grad: Floats, h: Floats, gate_cache: Floats, dgi: Bits, dgh: Bits,
    dbi: Floats, dbn: Floats,
) -> None:  # fmt: skip
    """Gradients of one step's gates, (B, 3H) each, added up over B into the biases' own.

    ``d`` (B, H) comes as what the next step's z let through, leaves as what this one's does. ``grad_recurrent`` is what
    came by the next step's product, ``grad`` what its own output got. ``dbn`` is b_hn's; b_h's other two are b_i's.
    """
    size = h.shape[1]
    work = np.empty(3 * size, np.float32)
    ar, az, an = work[:size], work[size : 2 * size], work[2 * size :]
    for b in range(h.shape[0]):
        r, z, n = gate_cache[b, :size], gate_cache[b, size : 2 * size], gate_cache[b, 2 * size : 3 * size]
        m = gate_cache[b, 3 * size :]
        total = d[b]
        for j in range(size):
            total[j] += grad[b, j] + _up(grad_recurrent[b, j])
        for j in range(size):
            an[j] = total[j] * (ONE - z[j]) * (ONE - n[j] * n[j])
        for j in range(size):
            az[j] = total[j] * (h[b, j] - n[j]) * z[j] * (ONE - z[j])
        for j in range(size):
            ar[j] = an[j] * m[j] * r[j] * (ONE - r[j])
        for j in range(size):
            total[j] *= z[j]
        lower(work, dgi[b])
        for j in range(3 * size):
            dbi[j] += work[j]
        for j in range(size):
            an[j] *= r[j]
        for j in range(size):
            dbn[j] += an[j]
        lower(work, dgh[b])


@_compiled
def bias_relu(x: Bits, bias: Floats) -> None:
    """x <- ReLU(x + bias); (N, K), (K,)."""
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            y = _up(x[i, j]) + bias[j]
            x[i, j] = _down(np.float32(0.0) if y < np.float32(0.0) else y)


@_compiled
def relu_back(grad: Bits, x: Bits, db: Floats) -> None:
    """grad <- grad where the ReLU's output x is not 0, added up over N into db; (N, K), (N, K), (K,)."""
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            grad[i, j] = grad[i, j] if x[i, j] != 0 else np.uint16(0)
        for j in range(x.shape[1]):
            db[j] += _up(grad[i, j])


@_compiled
def dot(x: Bits, w: Floats, bias: Floats, out: Floats) -> None:
    """out <- x w + bias, a layer with one output; (N, K), (K,), (1,), (N,)."""
    for i in range(x.shape[0]):
        total = bias[0]
        for j in range(x.shape[1]):
            total += _up(x[i, j]) * w[j]
        out[i] = total


@_compiled
def adam(
    w: Floats, grad: Floats, mean: Floats, square: Floats, low: Bits, step: Floats,
    rate: float, beta1: float, beta2: float, eps: float,
) -> None:  # fmt: skip
    """A step of Adam (Kingma and Ba, 2015, algorithm 1) in place, and ``low`` <- w in bfloat16; (K,), ``step`` (1,).

    ``low`` may be (0,): then nothing is rounded.
    """
    step[0] += ONE
    by_mean, by_square = np.float32(1.0 - beta1), np.float32(1.0 - beta2)
    decay, floor = np.float32(beta2), np.float32(eps)
    size = np.float32(rate / (1.0 - beta1 ** np.float64(step[0])))
    root = np.float32(1.0 / np.sqrt(1.0 - beta2 ** np.float64(step[0])))
    for begin in range(0, w.size, BLOCK):
        end = min(begin + BLOCK, w.size)
        x, g, m, v = w[begin:end], grad[begin:end], mean[begin:end], square[begin:end]
        for j in range(x.size):
            first, second = m[j] + by_mean * (g[j] - m[j]), decay * v[j] + by_square * g[j] * g[j]
            m[j], v[j] = first, second
            x[j] -= size * first / (np.sqrt(second) * root + floor)
        if low.size:
            lower(x, low[begin:end])


@_compiled
def statistics(x: Bits, share: Floats, mean: Floats, variance: Floats) -> None:
    """Mean and variance of each unit, a row's weight its ``share``; (N, K), (N,), and into (K,), (K,)."""
    mean[:] = np.float32(0.0)
    variance[:] = np.float32(0.0)
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            mean[j] += share[i] * _up(x[i, j])
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            apart = _up(x[i, j]) - mean[j]
            variance[j] += share[i] * apart * apart


@_compiled
def normalize(x: Bits, mean: Floats, scale: Floats, out: Bits) -> None:
    """out <- (x - mean) scale; (N, K), (K,), (K,), (N, K)."""
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            out[i, j] = _down((_up(x[i, j]) - mean[j]) * scale[j])


@_compiled
def normalize_scaled(
    x: Bits, mean: Floats, scale: Floats, gain: Floats, offset: Floats, normed: Bits, out: Bits
) -> None:  # fmt: skip
    """normed <- (x - mean) scale, and out <- normed gain + offset; (N, K), (K,) four times, (N, K), (N, K)."""
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            y = (_up(x[i, j]) - mean[j]) * scale[j]
            normed[i, j] = _down(y)
            out[i, j] = _down(y * gain[j] + offset[j])


@_compiled
def normalize_back(grad: Bits, normed: Bits, scale: Floats, share: Floats, dgain: Floats, doffset: Floats) -> None:
    """grad <- the gradient of what was normalised; (N, K), (N, K) what it became, (K,), (N,), and into (K,), (K,).

    ``scale`` has the gain in it. ``share`` is that of the statistics, through which a gradient comes, too: none where
    they are given, all shares 0.
    """
    dgain[:] = np.float32(0.0)
    doffset[:] = np.float32(0.0)
    for i in range(grad.shape[0]):
        for j in range(grad.shape[1]):
            doffset[j] += _up(grad[i, j])
        for j in range(grad.shape[1]):
            dgain[j] += _up(grad[i, j]) * _up(normed[i, j])
    for i in range(grad.shape[0]):
        for j in range(grad.shape[1]):
            through = share[i] * (doffset[j] + _up(normed[i, j]) * dgain[j])
            grad[i, j] = _down(scale[j] * (_up(grad[i, j]) - through))
