"""Writes a `PolicyNetwork` as an ONNX graph, node by node. Needs torch and onnx; used by the exporter only.

The graph is written out rather than traced: it is small, its names are readable, its bytes are the same on every export, and
nothing of the exporting machine (paths, stack traces) gets into the file. That it computes what the network computes is not
assumed: `policy_export.verify` steps both before a file is written.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from policy_export.network import (
    ACCELERATION_SCALE_M_S2,
    DIRECTION_SOFTENING_M,
    MOTION_LIMIT,
    POSITION_SCALE_M,
    SHARP_LENGTH_M,
    VELOCITY_SCALE_M_S,
    PolicyNetwork,
)

if TYPE_CHECKING:
    from torch import Tensor, nn

OPSET = 18
IR_VERSION = 10
MemoryForm = Literal["fused", "gates"]

# `python -m benchmarks inference` measures both in one run: on a shared Xeon core the medians are equal (30.3 us written out,
# 30.4 us as one node) and the tails differ by less than the noise between runs. The written-out form wins the tie: it needs
# only elementary operators, which every runtime has.
DEFAULT_MEMORY_FORM: MemoryForm = "gates"


class _Graph:
    """Collects nodes and initialisers; every method returns the name of the value it made."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.initialisers: dict[str, onnx.TensorProto] = {}

    def op(self, kind: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        return self.ops(kind, *inputs, outs=(out or f"{kind.lower()}_{len(self.nodes)}",), **attributes)[0]

    def ops(self, kind: str, *inputs: str, outs: tuple[str, ...], **attributes: Any) -> tuple[str, ...]:
        self.nodes.append(helper.make_node(kind, inputs, outs, name=f"{kind}_{len(self.nodes)}", **attributes))
        return outs

    def floats(self, name: str, values: object) -> str:
        return self._store(name, np.asarray(values, dtype=np.float32))

    def ints(self, name: str, *values: int) -> str:
        return self._store(name, np.asarray(values, dtype=np.int64))

    def _store(self, name: str, array: NDArray[np.float32] | NDArray[np.int64]) -> str:
        tensor = numpy_helper.from_array(np.ascontiguousarray(array).reshape(array.shape), name)
        if name in self.initialisers and self.initialisers[name] != tensor:
            raise ValueError(f"two different initialisers are called {name}")
        self.initialisers[name] = tensor
        return name

    def linear(self, value: str, name: str, layer: nn.Linear, out: str = "") -> str:
        weight, bias = self.floats(f"{name}.weight", _array(layer.weight)), self.floats(f"{name}.bias", _array(layer.bias))
        return self.op("Gemm", value, weight, bias, out=out, transB=1)


def build_model(network: PolicyNetwork, memory_form: MemoryForm = DEFAULT_MEMORY_FORM) -> onnx.ModelProto:
    """The ONNX model of `network`, without metadata. `memory_form`: one LSTM node, or its gates written out."""
    graph = _Graph()
    features = _features(graph, network)
    memory = _memory(graph, network, features, memory_form)
    _heads(graph, network, memory, features)
    inputs, outputs = _ports(network)
    proto = helper.make_graph(graph.nodes, "lstm_pilot_policy", inputs, outputs, list(graph.initialisers.values()))
    model = helper.make_model(proto, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="lstm-pilot")
    model.ir_version = IR_VERSION
    onnx.checker.check_model(model, full_check=True)
    return model


def _array(tensor: Tensor) -> NDArray[np.float32]:
    values: NDArray[np.float32] = tensor.detach().cpu().float().numpy()
    return values


def _ports(network: PolicyNetwork) -> tuple[list[onnx.ValueInfoProto], list[onnx.ValueInfoProto]]:
    def port(name: str, *shape: int | str) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    size = network.config.state_size
    state_in = [port(name, 1, "batch", size) for name in ("h_in", "c_in")] if size else []
    state_out = [port(name, 1, "batch", size) for name in ("h_out", "c_out")] if size else []
    observation = port("obs", "batch", network.config.observation_size)
    return [observation, *state_in], [port("action", "batch", 4), *state_out, port("value", "batch")]


def _features(graph: _Graph, network: PolicyNetwork) -> str:
    beams = network.config.beams
    zero, limit = graph.floats("zero", 0.0), graph.floats("range_max", network.config.range_max_m)
    sizes = graph.ints("split_sizes", beams, 3, 6, 1)
    lidar, goal, motion, yaw = graph.ops("Split", "obs", sizes, outs=("lidar", "goal", "motion", "yaw"), axis=1)
    ranges = graph.op("Clip", lidar, zero, limit)
    scale = graph.floats("motion_scale", [1.0 / VELOCITY_SCALE_M_S] * 3 + [1.0 / ACCELERATION_SCALE_M_S2] * 3)
    bounds = graph.floats("motion_low", -MOTION_LIMIT), graph.floats("motion_high", MOTION_LIMIT)
    motion = graph.op("Clip", graph.op("Mul", motion, scale), *bounds)
    if network.config.preprocessing == "channels":
        parts = [graph.op("Div", ranges, limit), graph.op("Div", goal, graph.floats("goal_scale", POSITION_SCALE_M)), motion]
        parts.append(graph.op("Div", yaw, graph.floats("pi", math.pi)))
    else:
        turn = (graph.op("Sin", yaw), graph.op("Cos", yaw))
        parts = [*_shaped_lidar(graph, network, ranges), *_shaped_goal(graph, goal), motion, *turn]
    return graph.op("Concat", *parts, out="features", axis=1)


def _shaped_lidar(graph: _Graph, network: PolicyNetwork, ranges: str) -> tuple[str, str]:
    config = network.config
    groups = graph.op("Reshape", ranges, graph.ints("group_shape", 0, config.beams // config.beam_group, config.beam_group))
    nearest = graph.op("ReduceMin", groups, graph.ints("group_axis", 2), out="nearest", keepdims=0)
    margin = graph.op("Sub", graph.floats("vehicle_radius", config.vehicle_radius_m), nearest)
    sharp = graph.op("Exp", graph.op("Div", margin, graph.floats("sharp_length", SHARP_LENGTH_M)))
    return graph.op("Div", nearest, "range_max"), sharp


def _shaped_goal(graph: _Graph, goal: str) -> tuple[str, str, str]:
    one = graph.floats("one", 1.0)
    distance = graph.op("ReduceL2", goal, graph.ints("goal_axis", 1), out="distance", keepdims=1)
    direction = graph.op("Div", goal, graph.op("Add", distance, graph.floats("softening", DIRECTION_SOFTENING_M)))
    beyond = graph.op("Add", distance, one)
    far = graph.op("Div", graph.op("Log", beyond), graph.floats("log_scale", math.log1p(POSITION_SCALE_M)))
    return direction, far, graph.op("Div", distance, beyond)


def _memory(graph: _Graph, network: PolicyNetwork, features: str, form: MemoryForm) -> str:
    if network.encoder is not None:
        return graph.op("Tanh", graph.linear(features, "encoder", network.encoder))
    return _fused_lstm(graph, network, features) if form == "fused" else _written_gates(graph, network, features)


def _fused_lstm(graph: _Graph, network: PolicyNetwork, features: str) -> str:
    """One LSTM node. ONNX orders the gates i, o, f, g; torch i, f, g, o."""
    w_ih, w_hh, b_ih, b_hh = (np.concatenate([part[k] for k in (0, 3, 1, 2)]) for part in _gate_blocks(network))
    names = (
        graph.floats("lstm.W", w_ih[None]),
        graph.floats("lstm.R", w_hh[None]),
        graph.floats("lstm.B", np.concatenate((b_ih, b_hh))[None]),
    )
    first = graph.ints("first_axis", 0)
    sequence = graph.op("Unsqueeze", features, first)
    size = network.config.hidden_size
    graph.ops("LSTM", sequence, *names, "", "h_in", "c_in", outs=("", "h_out", "c_out"), hidden_size=size)
    return graph.op("Squeeze", "h_out", first, out="memory")


def _written_gates(graph: _Graph, network: PolicyNetwork, features: str) -> str:
    """One matrix product for all gates over [features, h], ordered i, f, o, g so that one Sigmoid serves three of them."""
    w_ih, w_hh, b_ih, b_hh = (np.concatenate([part[k] for k in (0, 1, 3, 2)]) for part in _gate_blocks(network))
    size = network.config.hidden_size
    flat = graph.ints("state_flat", -1, size)
    h_in, c_in = graph.op("Reshape", "h_in", flat), graph.op("Reshape", "c_in", flat)
    # Stored transposed, so that a single row (one vehicle) runs through memory in order.
    weight = graph.floats("lstm.weight", np.concatenate((w_ih, w_hh), axis=1).T)
    joined = graph.op("Concat", features, h_in, axis=1)
    gates = graph.op("Gemm", joined, weight, graph.floats("lstm.bias", b_ih + b_hh))
    parts = graph.ints("gate_split", 3 * size, size)
    open_gates, candidate = graph.ops("Split", gates, parts, outs=("open_gates", "candidate"), axis=1)
    opened = graph.op("Sigmoid", open_gates)
    thirds = graph.ints("third_split", size, size, size)
    i, f, o = graph.ops("Split", opened, thirds, outs=("gate_i", "gate_f", "gate_o"), axis=1)
    c_out = graph.op("Add", graph.op("Mul", f, c_in), graph.op("Mul", i, graph.op("Tanh", candidate)))
    h_out = graph.op("Mul", o, graph.op("Tanh", c_out), out="memory")
    lifted = graph.ints("state_shape", 1, -1, size)
    graph.op("Reshape", h_out, lifted, out="h_out")
    graph.op("Reshape", c_out, lifted, out="c_out")
    return h_out


def _gate_blocks(network: PolicyNetwork) -> list[list[NDArray[np.float32]]]:
    """w_ih, w_hh, b_ih, b_hh, each cut into torch's four gates i, f, g, o."""
    return [np.split(_array(weight), 4) for weight in network.lstm_weights()]


def _heads(graph: _Graph, network: PolicyNetwork, memory: str, features: str) -> None:
    joined = graph.op("Concat", memory, features, axis=1) if network.config.feature_skip else memory
    mean = _head(graph, "policy_head", network.policy_head, joined)
    value = _head(graph, "value_head", network.value_head, joined)
    low, high = _array(network.action_low), _array(network.action_high)
    scaled = graph.op("Mul", graph.op("Tanh", mean), graph.floats("action_half", 0.5 * (high - low)))
    graph.op("Add", scaled, graph.floats("action_middle", 0.5 * (high + low)), out="action")
    graph.op("Squeeze", value, graph.ints("value_axis", 1), out="value")


def _head(graph: _Graph, name: str, head: nn.Sequential, value: str) -> str:
    first, _, last = head
    hidden = graph.op("Tanh", graph.linear(value, f"{name}.0", first))  # type: ignore[arg-type]  # Sequential is untyped
    return graph.linear(hidden, f"{name}.2", last)  # type: ignore[arg-type]
