"""What a policy remembers: an LSTM, a GRU, the last frames side by side, or nothing. Needs torch.

Each is a layer with the same two methods. `step(features [B, F], h, c)` gives (output [B, H], h', c'); `sequence(features
[T, B, F], h, c, reset [T, B])` gives (output [T, B, H], h', c') and clears the state before step t where `reset[t]` is true. A
state is [B, W]; `widths` are those of h and c, 0 for what a memory does not use: it is then passed through.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from policy_export.gru_sequence import gru_sequence
from policy_export.lstm_sequence import lstm_sequence

Weights = tuple[Tensor, Tensor, Tensor, Tensor]
Remembered = tuple[Tensor, Tensor, Tensor]


class LstmMemory(nn.LSTM):
    """One LSTM layer; h and c [B, H]."""

    @property
    def widths(self) -> tuple[int, int]:
        """See the module."""
        return self.hidden_size, self.hidden_size

    def weights(self) -> Weights:
        """w_ih [4H, F], w_hh [4H, H], b_ih [4H], b_hh [4H], gate order i, f, g, o."""
        weight_ih, weight_hh, bias_ih, bias_hh = self.parameters()
        return weight_ih, weight_hh, bias_ih, bias_hh

    def step(self, features: Tensor, h: Tensor, c: Tensor) -> Remembered:
        """The LSTM's equations written out for one step."""
        weight_ih, weight_hh, bias_ih, bias_hh = self.weights()
        gates = nn.functional.linear(features, weight_ih, bias_ih + bias_hh) + nn.functional.linear(h, weight_hh)
        i, f, g, o = gates.chunk(4, dim=-1)
        c_next = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
        h_next = torch.sigmoid(o) * torch.tanh(c_next)
        return h_next, h_next, c_next

    def sequence(self, features: Tensor, h: Tensor, c: Tensor, reset: Tensor) -> Remembered:
        """See the module."""
        output, (h_last, c_last) = lstm_sequence(features, self.weights(), (h, c), reset)
        return output, h_last, c_last


class GruMemory(nn.GRU):
    """One GRU layer; h [B, H]. c has the same width, so that a policy file has the same ports, and is never read."""

    @property
    def widths(self) -> tuple[int, int]:
        """See the module."""
        return self.hidden_size, self.hidden_size

    def weights(self) -> Weights:
        """w_ih [3H, F], w_hh [3H, H], b_ih [3H], b_hh [3H], gate order r, z, n."""
        weight_ih, weight_hh, bias_ih, bias_hh = self.parameters()
        return weight_ih, weight_hh, bias_ih, bias_hh

    def step(self, features: Tensor, h: Tensor, c: Tensor) -> Remembered:
        """The GRU's equations written out for one step."""
        weight_ih, weight_hh, bias_ih, bias_hh = self.weights()
        r, z, n = nn.functional.linear(features, weight_ih, bias_ih).chunk(3, dim=-1)
        h_r, h_z, h_n = nn.functional.linear(h, weight_hh, bias_hh).chunk(3, dim=-1)
        candidate = torch.tanh(n + torch.sigmoid(r + h_r) * h_n)
        h_next = candidate + torch.sigmoid(z + h_z) * (h - candidate)
        return h_next, h_next, c

    def sequence(self, features: Tensor, h: Tensor, c: Tensor, reset: Tensor) -> Remembered:
        """See the module."""
        output, h_last = gru_sequence(features, self.weights(), h, reset)
        return output, h_last, c


class NoMemory(nn.Linear):
    """A hidden layer of the memory's width, so that a network without memory has similar capacity."""

    @property
    def widths(self) -> tuple[int, int]:
        """See the module."""
        return 0, 0

    def step(self, features: Tensor, h: Tensor, c: Tensor) -> Remembered:
        """See the module."""
        return torch.tanh(self(features)), h, c

    def sequence(self, features: Tensor, h: Tensor, c: Tensor, reset: Tensor) -> Remembered:
        """See the module."""
        return torch.tanh(self(features)), h, c


class StackMemory(nn.Linear):
    """A hidden layer over the last `frames` feature vectors, the newest first; those before the episode's start are zero.

    h [B, (frames - 1) * F] are the frames before the present one.
    """

    def __init__(self, features: int, hidden: int, frames: int) -> None:
        super().__init__(features * frames, hidden)
        self.features, self.frames = features, frames

    @property
    def widths(self) -> tuple[int, int]:
        """See the module."""
        return self.features * (self.frames - 1), 0

    def step(self, features: Tensor, h: Tensor, c: Tensor) -> Remembered:
        """See the module."""
        window = torch.cat((features, h), dim=-1)
        return torch.tanh(self(window)), window[:, : h.shape[1]], c

    def sequence(self, features: Tensor, h: Tensor, c: Tensor, reset: Tensor) -> Remembered:
        """See the module."""
        steps, batch, _ = features.shape
        earlier = h.reshape(batch, self.frames - 1, self.features).transpose(0, 1).flip(0)
        line = torch.cat((earlier, features))  # oldest first: frame k before step t is line[t + frames - 1 - k]
        windows = line.unfold(0, self.frames, 1).flip(-1).permute(0, 1, 3, 2)  # [T, B, frames, F], newest first
        windows = windows * self._visible(reset).to(features.dtype).unsqueeze(-1)
        flat = windows.reshape(steps, batch, -1)
        return torch.tanh(self(flat)), flat[-1, :, : h.shape[1]], c

    def _visible(self, reset: Tensor) -> Tensor:
        """[T, B, frames]: whether the frame so many steps back belongs to the same episode, as far as this sequence tells."""
        steps = torch.arange(reset.shape[0], device=reset.device)
        begun = torch.where(reset.bool(), steps.unsqueeze(1), torch.full_like(steps.unsqueeze(1), -self.frames))
        age = steps.unsqueeze(1) - begun.cummax(dim=0).values
        return torch.arange(self.frames, device=reset.device) <= age.unsqueeze(-1)


Memory = LstmMemory | GruMemory | NoMemory | StackMemory
