"""The learner's LSTM: `policy_export.lstm_sequence` with all gates of a time step in one compiled loop, float32 on the CPU.

A time step of a few dozen sequences is too small for tensor operations: their overhead is larger than their work. Here a step is
one matrix product and one compiled loop, forwards and backwards. The tests compare values and gradients with the reference.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from policy_export.memory import LstmMemory, Memory, Remembered

F32 = NDArray[np.float32]

_HALF, _ONE, _TWO, _QUARTER = (np.float32(value) for value in (0.5, 1.0, 2.0, 0.25))
_FLAT = np.float32(9.0)  # beyond this |x| float32's tanh is 1
# Lambert's continued fraction of tanh, cut after the seventh term: numerator x (n0 + n1 x^2 + ...), denominator d0 + ...
_N0, _N1, _N2 = (np.float32(value) for value in (135135.0, 17325.0, 378.0))
_D1, _D2, _D3 = (np.float32(value) for value in (62370.0, 3150.0, 28.0))
# NaN must come out as NaN, so that a run that diverges is seen: the compiler may fuse, but not assume finite numbers.
_FUSE = {"contract", "arcp", "nsz"}


@njit(inline="always", fastmath=_FUSE, error_model="numpy")
def _tanh(x: np.float32) -> np.float32:
    """tanh to a few units of float32: the fraction is good to 1e-8 below 2.25, the half-angle formula does the rest twice."""
    x = _FLAT if x > _FLAT else x
    x = -_FLAT if x < -_FLAT else x
    q = x * _QUARTER
    s = q * q
    t = q * (_N0 + s * (_N1 + s * (_N2 + s))) / (_N0 + s * (_D1 + s * (_D2 + s * _D3)))
    t = _TWO * t / (_ONE + t * t)
    return _TWO * t / (_ONE + t * t)


@njit(inline="always", fastmath=_FUSE, error_model="numpy")
def _sigmoid(x: np.float32) -> np.float32:
    return _HALF + _HALF * _tanh(_HALF * x)


@njit(cache=True, fastmath=_FUSE, error_model="numpy")
def _open_gates(t: int, gates: F32, c_before: F32, tanh_c: F32, output: F32, h_before: F32, keep: F32) -> None:
    """Activate the gates [T, B, 4H] of step t in place; write its output, and the masked states that enter step t + 1."""
    hidden = output.shape[2]
    for b in range(output.shape[1]):
        row, kept = gates[t, b], keep[t + 1, b]
        i, f, g, o = row[:hidden], row[hidden : 2 * hidden], row[2 * hidden : 3 * hidden], row[3 * hidden :]
        for k in range(hidden):
            i[k], f[k], g[k], o[k] = _sigmoid(i[k]), _sigmoid(f[k]), _tanh(g[k]), _sigmoid(o[k])
            c = f[k] * c_before[t, b, k] + i[k] * g[k]
            tanh_c[t, b, k] = _tanh(c)
            output[t, b, k] = o[k] * tanh_c[t, b, k]
            h_before[t + 1, b, k] = output[t, b, k] * kept
            c_before[t + 1, b, k] = c * kept


@njit(cache=True, fastmath=_FUSE, error_model="numpy")
def _close_gates(
    t: int, gates: F32, c_before: F32, tanh_c: F32, d_output: F32, keep: F32, d_h_later: F32, d_c: F32, d_gates: F32
) -> None:
    """Gradients of what enters the gates of step t into `d_gates` [T, B, 4H], and `d_c` [B, H] moved from step t + 1 to t.

    `d_h_later` [B, H]: what step t + 1 says of the state that entered it, before the mask.
    """
    hidden = tanh_c.shape[2]
    for b in range(tanh_c.shape[1]):
        row, kept = gates[t, b], keep[t + 1, b]
        i, f, g, o = row[:hidden], row[hidden : 2 * hidden], row[2 * hidden : 3 * hidden], row[3 * hidden :]
        row = d_gates[t, b]
        d_i, d_f, d_g, d_o = row[:hidden], row[hidden : 2 * hidden], row[2 * hidden : 3 * hidden], row[3 * hidden :]
        for k in range(hidden):
            tc = tanh_c[t, b, k]
            d_h = d_output[t, b, k] + d_h_later[b, k] * kept
            d_cell = d_c[b, k] * kept + d_h * o[k] * (_ONE - tc * tc)
            d_i[k] = d_cell * g[k] * i[k] * (_ONE - i[k])
            d_f[k] = d_cell * c_before[t, b, k] * f[k] * (_ONE - f[k])
            d_g[k] = d_cell * i[k] * (_ONE - g[k] * g[k])
            d_o[k] = d_h * tc * o[k] * (_ONE - o[k])
            d_c[b, k] = d_cell * f[k]


class _FastLstm(torch.autograd.Function):
    """`(projected[T,B,4H], weight_hh[4H,H], h0[B,H], c0[B,H], keep[T+1,B])` to `(output[T,B,H], c_last[B,H])`."""

    @staticmethod
    def forward(ctx: Any, projected: Tensor, weight_hh: Tensor, h0: Tensor, c0: Tensor, keep: Tensor) -> tuple[Tensor, Tensor]:
        steps, batch, width = projected.shape
        gates = projected.clone(memory_format=torch.contiguous_format)
        h_before, c_before = (projected.new_empty(steps + 1, batch, width // 4) for _ in range(2))  # masked; last: final
        tanh_c, output = (projected.new_empty(steps, batch, width // 4) for _ in range(2))
        torch.mul(h0, keep[0].unsqueeze(1), out=h_before[0])
        torch.mul(c0, keep[0].unsqueeze(1), out=c_before[0])
        arrays = [tensor.numpy() for tensor in (gates, c_before, tanh_c, output, h_before, keep)]
        recurrent = weight_hh.t()
        for t, (gate, h) in enumerate(zip(gates.unbind(), h_before.unbind()[:-1], strict=True)):
            gate.addmm_(h, recurrent)
            _open_gates(t, *arrays)
        ctx.save_for_backward(gates, h_before, c_before, tanh_c, weight_hh, keep)
        return output, c_before[-1]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        d_output, d_c_last = gradients
        gates, h_before, c_before, tanh_c, weight_hh, keep = ctx.saved_tensors
        steps, _, width = gates.shape
        d_gates, d_h, d_c = torch.empty_like(gates), torch.zeros_like(d_c_last), d_c_last.clone()
        saved = [tensor.numpy() for tensor in (gates, c_before, tanh_c, d_output.contiguous(), keep, d_h, d_c, d_gates)]
        rows = d_gates.unbind()
        for t in range(steps - 1, -1, -1):
            _close_gates(t, *saved)
            torch.mm(rows[t], weight_hh, out=d_h)
        d_weight = d_gates.reshape(-1, width).t() @ h_before[:-1].reshape(-1, width // 4)
        first = keep[0].unsqueeze(1)
        return d_gates, d_weight, d_h * first, d_c * first, None


class RolloutMemory:
    """One step after another of an `LstmMemory` whose weights stay as they are while a rollout lasts, without gradients."""

    def __init__(self, memory: LstmMemory, batch: int) -> None:
        weight_ih, weight_hh, bias_ih, bias_hh = memory.weights()
        self._weight = torch.cat((weight_ih, weight_hh), dim=1).t().contiguous()
        self._bias = bias_ih + bias_hh
        self._keep: F32 = np.ones((2, batch), np.float32)  # whoever calls has masked the states

    def step(self, features: Tensor, h: Tensor, c: Tensor) -> Remembered:
        """As `LstmMemory.step`: features [B, F], h, c [B, H]."""
        gates = torch.addmm(self._bias, torch.cat((features, h), dim=1), self._weight)
        states, outputs = features.new_empty(2, 2, *c.shape), features.new_empty(2, 1, *c.shape)
        states[0, 0] = c
        cells, hiddens = states.numpy()
        tanh_c, output = outputs.numpy()
        _open_gates(0, gates.unsqueeze(0).numpy(), cells, tanh_c, output, hiddens, self._keep)
        return outputs[1, 0], outputs[1, 0], states[0, 1]


def rollout_memory(memory: Memory, batch: int) -> Memory | RolloutMemory:
    """What a rollout steps: the compiled form of an LSTM on the CPU, any other memory as it is."""
    if isinstance(memory, LstmMemory) and next(memory.parameters()).device.type == "cpu":
        return RolloutMemory(memory, batch)
    return memory


def fast_lstm_sequence(memory: LstmMemory, features: Tensor, h: Tensor, c: Tensor, reset: Tensor) -> Remembered:
    """As `LstmMemory.sequence`: features [T, B, F], h, c [B, H], reset [T, B] to output [T, B, H] and the last h, c."""
    if features.dtype != torch.float32 or features.device.type != "cpu":
        return memory.sequence(features, h, c, reset)
    weight_ih, weight_hh, bias_ih, bias_hh = memory.weights()
    projected = torch.nn.functional.linear(features, weight_ih, bias_ih + bias_hh)
    keep = torch.ones(features.shape[0] + 1, features.shape[1])
    keep[:-1] -= reset.to(torch.float32)
    output, c_last = _FastLstm.apply(projected, weight_hh, h, c, keep)  # type: ignore[no-untyped-call]  # torch leaves it untyped
    return output, output[-1], c_last
