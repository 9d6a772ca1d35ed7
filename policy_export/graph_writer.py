"""Writes ONNX graphs node by node: what the graphs of all trained networks share. Needs torch and onnx; for the exporter only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

if TYPE_CHECKING:
    from torch import Tensor, nn

OPSET = 18
IR_VERSION = 10
MemoryForm = Literal["fused", "gates"]
LayerWeights = tuple["Tensor", "Tensor", "Tensor", "Tensor"]
"""w_ih [4H, F], w_hh [4H, H], b_ih [4H], b_hh [4H], gate order i, f, g, o as in torch."""

# `python -m benchmarks inference` measures both in one run: on a shared Xeon core the medians are equal (30.3 us written out,
# 30.4 us as one node) and the tails differ by less than the noise between runs. The written-out form wins the tie: it needs
# only elementary operators, which every runtime has.
DEFAULT_MEMORY_FORM: MemoryForm = "gates"


class NetworkShape(Protocol):
    """What the graph's inputs and outputs depend on."""

    @property
    def observation_size(self) -> int:
        """Length of one observation."""

    @property
    def action_size(self) -> int:
        """Number of actions in the file."""

    @property
    def layers(self) -> int:
        """Stacked LSTM layers."""

    @property
    def state_size(self) -> int:
        """Width of h and of c of one layer; 0 without memory."""


class GraphWriter:
    """Collects nodes and initialisers; every method returns the name of the value it made."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.initialisers: dict[str, onnx.TensorProto] = {}

    def op(self, kind: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        """One node with one output, called `out` or after its kind and place."""
        return self.ops(kind, *inputs, outs=(out or f"{kind.lower()}_{len(self.nodes)}",), **attributes)[0]

    def ops(self, kind: str, *inputs: str, outs: tuple[str, ...], **attributes: Any) -> tuple[str, ...]:
        """One node with several outputs."""
        self.nodes.append(helper.make_node(kind, inputs, outs, name=f"{kind}_{len(self.nodes)}", **attributes))
        return outs

    def floats(self, name: str, values: object) -> str:
        """A float32 initialiser."""
        return self._store(name, np.asarray(values, dtype=np.float32))

    def ints(self, name: str, *values: int) -> str:
        """An int64 initialiser with one axis."""
        return self._store(name, np.asarray(values, dtype=np.int64))

    def _store(self, name: str, array: NDArray[np.float32] | NDArray[np.int64]) -> str:
        tensor = numpy_helper.from_array(np.ascontiguousarray(array).reshape(array.shape), name)
        if name in self.initialisers and self.initialisers[name] != tensor:
            raise ValueError(f"two different initialisers are called {name}")
        self.initialisers[name] = tensor
        return name

    def linear(self, value: str, name: str, layer: nn.Linear, out: str = "") -> str:
        """A `torch.nn.Linear` with bias over `value` [B, F]."""
        weight, bias = self.floats(f"{name}.weight", as_array(layer.weight)), self.floats(f"{name}.bias", as_array(layer.bias))
        return self.op("Gemm", value, weight, bias, out=out, transB=1)

    def lstm(self, features: str, layers: Sequence[LayerWeights], form: MemoryForm) -> str:
        """Stacked LSTM layers for one step over `features` [B, F], from `h_in`, `c_in` to `h_out`, `c_out` [layers, B, H].

        Returns the output of the last layer [B, H].
        """
        value, states = features, {"h": [], "c": []}  # type: tuple[str, dict[str, list[str]]]
        single = len(layers) == 1
        incoming = {name: self._split_state(name, len(layers)) for name in ("h", "c")}
        write = self._fused_layer if form == "fused" else self._written_layer
        for k, weights in enumerate(layers):
            prefix = "lstm" if single else f"lstm.{k}"
            outs = ("h_out", "c_out") if single else (f"h_out_{k}", f"c_out_{k}")
            value = write(value, (incoming["h"][k], incoming["c"][k]), weights, prefix, outs)
            states["h"].append(outs[0])
            states["c"].append(outs[1])
        if not single:
            for name, parts in states.items():
                self.op("Concat", *parts, out=f"{name}_out", axis=0)
        return value

    def _split_state(self, name: str, count: int) -> tuple[str, ...]:
        if count == 1:
            return (f"{name}_in",)
        sizes = self.ints("layer_split", *[1] * count)
        return self.ops("Split", f"{name}_in", sizes, outs=tuple(f"{name}_in_{k}" for k in range(count)), axis=0)

    def _fused_layer(self, value: str, state: tuple[str, str], weights: LayerWeights, prefix: str, outs: tuple[str, ...]) -> str:
        """One LSTM node. ONNX orders the gates i, o, f, g; torch i, f, g, o."""
        w_ih, w_hh, b_ih, b_hh = _gates(weights, (0, 3, 1, 2))
        names = (
            self.floats(f"{prefix}.W", w_ih[None]),
            self.floats(f"{prefix}.R", w_hh[None]),
            self.floats(f"{prefix}.B", np.concatenate((b_ih, b_hh))[None]),
        )
        first = self.ints("first_axis", 0)
        sequence = self.op("Unsqueeze", value, first)
        self.ops("LSTM", sequence, *names, "", *state, outs=("", *outs), hidden_size=w_hh.shape[1])
        return self.op("Squeeze", outs[0], first, out=f"{prefix}.memory")

    def _written_layer(
        self, value: str, state: tuple[str, str], weights: LayerWeights, prefix: str, outs: tuple[str, ...]
    ) -> str:
        """One matrix product for all gates over [value, h], ordered i, f, o, g so that one Sigmoid serves three of them."""
        w_ih, w_hh, b_ih, b_hh = _gates(weights, (0, 1, 3, 2))
        size = w_hh.shape[1]
        flat = self.ints("state_flat", -1, size)
        h_in, c_in = (self.op("Reshape", name, flat) for name in state)
        # Stored transposed, so that a single row (one vehicle) runs through memory in order.
        weight = self.floats(f"{prefix}.weight", np.concatenate((w_ih, w_hh), axis=1).T)
        joined = self.op("Concat", value, h_in, axis=1)
        gates = self.op("Gemm", joined, weight, self.floats(f"{prefix}.bias", b_ih + b_hh))
        parts, thirds = self.ints("gate_split", 3 * size, size), self.ints("third_split", size, size, size)
        open_gates, candidate = self.ops("Split", gates, parts, outs=(f"{prefix}.open", f"{prefix}.candidate"), axis=1)
        opened = self.op("Sigmoid", open_gates)
        i, f, o = self.ops("Split", opened, thirds, outs=tuple(f"{prefix}.gate_{name}" for name in "ifo"), axis=1)
        c_out = self.op("Add", self.op("Mul", f, c_in), self.op("Mul", i, self.op("Tanh", candidate)))
        h_out = self.op("Mul", o, self.op("Tanh", c_out), out=f"{prefix}.memory")
        lifted = self.ints("state_shape", 1, -1, size)
        self.op("Reshape", h_out, lifted, out=outs[0])
        self.op("Reshape", c_out, lifted, out=outs[1])
        return h_out

    def gru(self, features: str, weights: LayerWeights) -> str:
        """One GRU layer for one step, written out, from `h_in` to `h_out` [1, B, H]; `c_in` is passed on. Returns [B, H]."""
        w_ih, w_hh, b_ih, b_hh = (as_array(weight) for weight in weights)
        size = w_hh.shape[1]
        h_in = self.op("Reshape", "h_in", self.ints("state_flat", -1, size))
        self.op("Identity", "c_in", out="c_out")
        names = ("r", "z", "n")
        from_x = self._gru_gates(features, "gru.input", w_ih, b_ih, names)
        from_h = self._gru_gates(h_in, "gru.hidden", w_hh, b_hh, names)
        r, z = (self.op("Sigmoid", self.op("Add", x, h)) for x, h in zip(from_x[:2], from_h[:2], strict=True))
        candidate = self.op("Tanh", self.op("Add", from_x[2], self.op("Mul", r, from_h[2])))
        kept = self.op("Mul", z, self.op("Sub", h_in, candidate))
        h_out = self.op("Add", candidate, kept, out="gru.memory")
        self.op("Reshape", h_out, self.ints("state_shape", 1, -1, size), out="h_out")
        return h_out

    def _gru_gates(
        self, value: str, prefix: str, weight: NDArray[np.float32], bias: NDArray[np.float32], names: tuple[str, ...]
    ) -> tuple[str, ...]:
        size = weight.shape[0] // len(names)
        weights = self.floats(f"{prefix}.weight", weight.T), self.floats(f"{prefix}.bias", bias)
        sizes = self.ints("gru_split", *[size] * len(names))
        outs = tuple(f"{prefix}.{name}" for name in names)
        return self.ops("Split", self.op("Gemm", value, *weights), sizes, outs=outs, axis=1)

    def model(self, shape: NetworkShape, has_value: bool) -> onnx.ModelProto:
        """The finished model, checked by the onnx package, without metadata."""
        inputs, outputs = _ports(shape, has_value)
        proto = helper.make_graph(self.nodes, "lstm_pilot_policy", inputs, outputs, list(self.initialisers.values()))
        model = helper.make_model(proto, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="lstm-pilot")
        model.ir_version = IR_VERSION
        onnx.checker.check_model(model, full_check=True)
        return model


def as_array(tensor: Tensor) -> NDArray[np.float32]:
    """A parameter's values in float32."""
    values: NDArray[np.float32] = tensor.detach().cpu().float().numpy()
    return values


def _gates(weights: LayerWeights, order: tuple[int, ...]) -> list[NDArray[np.float32]]:
    """w_ih, w_hh, b_ih, b_hh with torch's four gates i, f, g, o put in another order."""
    blocks = [np.split(as_array(weight), 4) for weight in weights]
    return [np.concatenate([part[k] for k in order]) for part in blocks]


def _ports(shape: NetworkShape, has_value: bool) -> tuple[list[onnx.ValueInfoProto], list[onnx.ValueInfoProto]]:
    def port(name: str, *sizes: int | str) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, sizes)

    layers, size = shape.layers, shape.state_size
    state_in = [port(name, layers, "batch", size) for name in ("h_in", "c_in")] if size else []
    state_out = [port(name, layers, "batch", size) for name in ("h_out", "c_out")] if size else []
    value = [port("value", "batch")] if has_value else []
    return [port("obs", "batch", shape.observation_size), *state_in], [
        port("action", "batch", shape.action_size),
        *state_out,
        *value,
    ]
