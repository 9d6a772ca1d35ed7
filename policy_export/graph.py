"""Writes a `PolicyNetwork` as an ONNX graph, node by node. Needs torch and onnx; used by the exporter only.

The graph is written out rather than traced: it is small, its names are readable, its bytes are the same on every export, and
nothing of the exporting machine (paths, stack traces) gets into the file. That it computes what the network computes is not
assumed: `policy_export.verify` steps both before a file is written.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import onnx

from policy_export.errors import PolicyError
from policy_export.graph_writer import DEFAULT_MEMORY_FORM, GraphWriter, MemoryForm, as_array
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
    from torch import nn


def build_model(network: PolicyNetwork, memory_form: MemoryForm = DEFAULT_MEMORY_FORM) -> onnx.ModelProto:
    """The ONNX model of `network`, without metadata. `memory_form`: one LSTM node, or its gates written out.

    Raises `PolicyError` for a memory that a policy file cannot carry.
    """
    if network.config.memory == "stack":
        raise PolicyError(
            "memory `stack` is for comparison in training: a policy file carries lstm, gru or none; train one of these"
        )
    graph = GraphWriter()
    features = _features(graph, network)
    if network.lstm is not None:
        memory = graph.lstm(features, [network.lstm.weights()], memory_form)
    elif network.gru is not None:
        memory = graph.gru(features, network.gru.weights())
    else:
        assert network.encoder is not None
        memory = graph.op("Tanh", graph.linear(features, "encoder", network.encoder))
    _heads(graph, network, memory, features)
    return graph.model(network.config, has_value=True)


def _features(graph: GraphWriter, network: PolicyNetwork) -> str:
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


def _shaped_lidar(graph: GraphWriter, network: PolicyNetwork, ranges: str) -> tuple[str, str]:
    config = network.config
    groups = graph.op("Reshape", ranges, graph.ints("group_shape", 0, config.beams // config.beam_group, config.beam_group))
    nearest = graph.op("ReduceMin", groups, graph.ints("group_axis", 2), out="nearest", keepdims=0)
    margin = graph.op("Sub", graph.floats("vehicle_radius", config.vehicle_radius_m), nearest)
    sharp = graph.op("Exp", graph.op("Div", margin, graph.floats("sharp_length", SHARP_LENGTH_M)))
    return graph.op("Div", nearest, "range_max"), sharp


def _shaped_goal(graph: GraphWriter, goal: str) -> tuple[str, str, str]:
    one = graph.floats("one", 1.0)
    distance = graph.op("ReduceL2", goal, graph.ints("goal_axis", 1), out="distance", keepdims=1)
    direction = graph.op("Div", goal, graph.op("Add", distance, graph.floats("softening", DIRECTION_SOFTENING_M)))
    beyond = graph.op("Add", distance, one)
    far = graph.op("Div", graph.op("Log", beyond), graph.floats("log_scale", math.log1p(POSITION_SCALE_M)))
    return direction, far, graph.op("Div", distance, beyond)


def _heads(graph: GraphWriter, network: PolicyNetwork, memory: str, features: str) -> None:
    joined = graph.op("Concat", memory, features, axis=1) if network.config.feature_skip else memory
    mean = _head(graph, "policy_head", network.policy_head, joined)
    value = _head(graph, "value_head", network.value_head, joined)
    low, high = as_array(network.action_low), as_array(network.action_high)
    scaled = graph.op("Mul", graph.op("Tanh", mean), graph.floats("action_half", 0.5 * (high - low)))
    graph.op("Add", scaled, graph.floats("action_middle", 0.5 * (high + low)), out="action")
    graph.op("Squeeze", value, graph.ints("value_axis", 1), out="value")


def _head(graph: GraphWriter, name: str, head: nn.Sequential, value: str) -> str:
    first, _, last = head
    hidden = graph.op("Tanh", graph.linear(value, f"{name}.0", first))  # type: ignore[arg-type]  # Sequential is untyped
    return graph.linear(hidden, f"{name}.2", last)  # type: ignore[arg-type]
