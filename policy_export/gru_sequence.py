"""One GRU layer over whole sequences with state resets inside them, with a written-out backward pass. See `lstm_sequence`.

The equations are those of `torch.nn.GRU` (gate order r, z, n); the tests compare values and gradients with a plain cell loop.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _GruSequence(torch.autograd.Function):
    """`(projected[T,B,3H], weight_hh[3H,H], bias_hh[3H], h0[B,H], keep[T,B,1])` to `output[T,B,H]`."""

    @staticmethod
    def forward(ctx: Any, projected: Tensor, weight_hh: Tensor, bias_hh: Tensor, h0: Tensor, keep: Tensor) -> Tensor:
        steps, batch, width = projected.shape
        hidden = width // 3
        gates = projected.clone()  # becomes the activated r, z, n in place
        h_before = projected.new_empty(steps, batch, hidden)  # masked states that enter each step
        candidate = torch.empty_like(h_before)  # the recurrent part of n, before its gate r
        output = torch.empty_like(h_before)
        recurrent, h = weight_hh.t(), h0
        for t in range(steps):
            torch.mul(h, keep[t], out=h_before[t])
            from_h = torch.addmm(bias_hh, h_before[t], recurrent)
            candidate[t] = from_h[:, 2 * hidden :]
            opened = gates[t, :, : 2 * hidden].add_(from_h[:, : 2 * hidden]).sigmoid_()
            n = gates[t, :, 2 * hidden :].addcmul_(opened[:, :hidden], candidate[t]).tanh_()
            h = torch.lerp(n, h_before[t], opened[:, hidden:], out=output[t])
        ctx.save_for_backward(gates, h_before, candidate, weight_hh, keep)
        return output

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (d_output,) = gradients
        gates, h_before, candidate, weight_hh, keep = ctx.saved_tensors
        steps, _, width = gates.shape
        hidden = width // 3
        d_gates = torch.empty_like(gates)  # of what enters r, z, n
        d_from_h = torch.empty_like(gates)  # of h W + b; differs from d_gates in n only
        d_h = torch.zeros_like(h_before[0])
        for t in range(steps - 1, -1, -1):
            r, z, n = gates[t].chunk(3, dim=1)
            d_h = d_h + d_output[t]
            d_n = d_h * (1.0 - z) * (1.0 - n.square())
            d_gates[t, :, :hidden] = d_n * candidate[t] * r * (1.0 - r)
            d_gates[t, :, hidden : 2 * hidden] = d_h * (h_before[t] - n) * z * (1.0 - z)
            d_gates[t, :, 2 * hidden :] = d_n
            d_from_h[t] = d_gates[t]
            d_from_h[t, :, 2 * hidden :] *= r
            d_h = torch.addcmul(torch.mm(d_from_h[t], weight_hh), d_h, z).mul_(keep[t])
        flat = d_from_h.reshape(-1, width)
        return d_gates, flat.t() @ h_before.reshape(-1, hidden), flat.sum(dim=0), d_h, None


def gru_sequence(
    inputs: Tensor, weights: tuple[Tensor, Tensor, Tensor, Tensor], h0: Tensor, reset: Tensor
) -> tuple[Tensor, Tensor]:
    """Run one GRU layer over `inputs` [T, B, F], zeroing an element's state before step t where `reset[t]` is true.

    `weights`: w_ih [3H, F], w_hh [3H, H], b_ih [3H], b_hh [3H] as in `torch.nn.GRU`. `h0`: [B, H]. `reset`: [T, B], bool or
    0/1. Returns the outputs [T, B, H] and the last state [B, H]; all differentiable.
    """
    weight_ih, weight_hh, bias_ih, bias_hh = weights
    projected = torch.nn.functional.linear(inputs, weight_ih, bias_ih)
    keep = (1.0 - reset.to(inputs.dtype)).unsqueeze(-1)
    output: Tensor = _GruSequence.apply(projected, weight_hh, bias_hh, h0, keep)  # type: ignore[no-untyped-call]  # untyped
    return output, output[-1]
