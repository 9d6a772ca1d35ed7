"""One LSTM layer over whole sequences with state resets inside them, with a written-out backward pass.

Cutting sequences at every reset costs most of the speed of a fused layer, and a cell loop under autograd costs more. Here the
input projection is one matrix product over all steps, the loop holds only the recurrent product and the gates, and the weight
gradients are one product each. The equations are those of `torch.nn.LSTM` (gate order i, f, g, o); the tests compare both
values and gradients with a plain cell loop.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _LstmSequence(torch.autograd.Function):
    """`(projected[T,B,4H], weight_hh[4H,H], h0[B,H], c0[B,H], keep[T,B,1])` to `(output[T,B,H], c_last[B,H])`."""

    @staticmethod
    def forward(ctx: Any, projected: Tensor, weight_hh: Tensor, h0: Tensor, c0: Tensor, keep: Tensor) -> tuple[Tensor, Tensor]:
        steps, batch, _ = projected.shape
        hidden = h0.shape[1]
        gates = projected.clone()  # becomes the activated gates i, f, g, o in place
        h_before = projected.new_empty(steps, batch, hidden)  # masked states that enter each step
        c_before = torch.empty_like(h_before)
        tanh_c = torch.empty_like(h_before)
        output = torch.empty_like(h_before)
        recurrent = weight_hh.t()
        h, c = h0, c0
        for t in range(steps):
            torch.mul(h, keep[t], out=h_before[t])
            torch.mul(c, keep[t], out=c_before[t])
            gate = gates[t].addmm_(h_before[t], recurrent)
            gate[:, : 2 * hidden].sigmoid_()
            gate[:, 2 * hidden : 3 * hidden].tanh_()
            gate[:, 3 * hidden :].sigmoid_()
            i, f, g, o = gate.chunk(4, dim=1)
            c = torch.mul(f, c_before[t]).addcmul_(i, g)
            torch.tanh(c, out=tanh_c[t])
            h = torch.mul(o, tanh_c[t], out=output[t])
        ctx.save_for_backward(gates, h_before, c_before, tanh_c, weight_hh, keep)
        return output, c

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        d_output, d_c_last = gradients
        gates, h_before, c_before, tanh_c, weight_hh, keep = ctx.saved_tensors
        steps, _, width = gates.shape
        hidden = width // 4
        d_gates = torch.empty_like(gates)
        d_h = torch.zeros_like(d_c_last)
        d_c = d_c_last.clone()
        for t in range(steps - 1, -1, -1):
            i, f, g, o = gates[t].chunk(4, dim=1)
            d_i, d_f, d_g, d_o = d_gates[t].chunk(4, dim=1)
            d_h = d_h + d_output[t]
            d_c = d_c.addcmul(d_h * o, 1.0 - tanh_c[t].square())
            d_i.copy_(d_c * g * (i * (1.0 - i)))
            d_f.copy_(d_c * c_before[t] * (f * (1.0 - f)))
            d_g.copy_(d_c * i * (1.0 - g.square()))
            d_o.copy_(d_h * tanh_c[t] * (o * (1.0 - o)))
            d_h = torch.mm(d_gates[t], weight_hh).mul_(keep[t])
            d_c = (d_c * f).mul_(keep[t])
        d_weight = d_gates.reshape(-1, width).t() @ h_before.reshape(-1, hidden)
        return d_gates, d_weight, d_h, d_c, None


def lstm_sequence(
    inputs: Tensor,
    weights: tuple[Tensor, Tensor, Tensor, Tensor],
    state: tuple[Tensor, Tensor],
    reset: Tensor,
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Run one LSTM layer over `inputs` [T, B, F], zeroing an element's state before step t where `reset[t]` is true.

    `weights`: w_ih [4H, F], w_hh [4H, H], b_ih [4H], b_hh [4H] as in `torch.nn.LSTM`. `state`: h0, c0 [B, H].
    `reset`: [T, B], bool or 0/1. Returns the outputs [T, B, H] and the last h, c [B, H]; all differentiable.
    """
    weight_ih, weight_hh, bias_ih, bias_hh = weights
    projected = torch.nn.functional.linear(inputs, weight_ih, bias_ih + bias_hh)
    keep = (1.0 - reset.to(inputs.dtype)).unsqueeze(-1)
    output, c_last = _LstmSequence.apply(projected, weight_hh, state[0], state[1], keep)  # type: ignore[no-untyped-call]  # torch leaves it untyped
    return output, (output[-1], c_last)
