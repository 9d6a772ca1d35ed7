"""Writes an `Sb3Network` as an ONNX graph, node by node. Needs torch and onnx; used by the exporter only."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import onnx
from torch import nn

from policy_export.graph_writer import DEFAULT_MEMORY_FORM, GraphWriter, MemoryForm
from policy_export.sb3_network import ActionMap, Normalisation, Sb3Network


def build_sb3_model(network: Sb3Network, memory_form: MemoryForm = DEFAULT_MEMORY_FORM) -> onnx.ModelProto:
    """The ONNX model of `network`, without metadata. `memory_form`: one LSTM node per layer, or the gates written out."""
    graph, config = GraphWriter(), network.config
    features = "obs" if config.normalisation is None else _normalised(graph, config.normalisation)
    latent = features
    if config.memory == "lstm":
        latent = graph.lstm(features, network.lstm_weights(), memory_form)
    hidden = _mlp(graph, "policy_net", network.mlp_extractor["policy_net"], latent, config.activation)
    _action(graph, graph.linear(hidden, "action_net", network.action_net), config.actions)
    if network.value_net is not None:
        seen = latent if network.critic is None else graph.linear(features, "critic", network.critic)
        hidden = _mlp(graph, "value_net", network.mlp_extractor["value_net"], seen, config.activation)
        value = graph.linear(hidden, "value_net.out", network.value_net)
        graph.op("Squeeze", value, graph.ints("value_axis", 1), out="value")
    return graph.model(config, has_value=config.has_value)


def _normalised(graph: GraphWriter, kept: Normalisation) -> str:
    """The mean is subtracted in two parts: float32 alone would lose it where the deviation is small (a beam that never moves)."""
    coarse = kept.mean.astype(np.float32)
    centred = graph.op("Sub", "obs", graph.floats("obs_mean", coarse))
    centred = graph.op("Sub", centred, graph.floats("obs_mean_rest", kept.mean - coarse.astype(np.float64)))
    scaled = graph.op("Mul", centred, graph.floats("obs_scale", 1.0 / kept.deviation))
    return graph.op("Clip", scaled, graph.floats("obs_low", -kept.clip), graph.floats("obs_high", kept.clip), out="features")


def _mlp(graph: GraphWriter, name: str, layers: nn.Module, value: str, activation: str) -> str:
    assert isinstance(layers, nn.Sequential)
    for k, layer in enumerate(layers):
        if isinstance(layer, nn.Linear):
            value = _ACTIVATION_NODES[activation](graph, graph.linear(value, f"{name}.{k}", layer))
    return value


def _action(graph: GraphWriter, mean: str, actions: ActionMap) -> None:
    """Squash or clip as `predict` does, scale to the file's limits, and put each action in its place.

    With squashing both scalings are one; without, the clip comes first, in the policy's own units.
    """
    low, high = actions.low, actions.high
    if actions.squash:
        half, middle = 0.5 * (actions.to_high - actions.to_low), 0.5 * (actions.to_high + actions.to_low)
        value = graph.op("Mul", graph.op("Tanh", mean), graph.floats("action_half", half))
        value = graph.op("Add", value, graph.floats("action_middle", middle))
    else:
        value = graph.op("Min", mean, graph.floats("action_high", high))
        value = graph.op("Max", value, graph.floats("action_low", low))
        if actions.is_rescaled:
            gain = (actions.to_high - actions.to_low) / (high - low)
            value = graph.op("Mul", value, graph.floats("action_gain", gain))
            value = graph.op("Add", value, graph.floats("action_offset", actions.to_low - gain * low))
    if actions.places == tuple(range(actions.size)):
        graph.op("Identity", value, out="action")
        return
    selection = np.zeros((len(actions.places), actions.size))
    selection[range(len(actions.places)), actions.places] = 1.0
    graph.op("MatMul", value, graph.floats("action_places", selection), out="action")


def _plain(kind: str, alpha: float | None = None) -> Callable[[GraphWriter, str], str]:
    if alpha is None:
        return lambda graph, value: graph.op(kind, value)
    return lambda graph, value: graph.op(kind, value, alpha=alpha)


def _clip(low: float, high: float) -> Callable[[GraphWriter, str], str]:
    def write(graph: GraphWriter, value: str) -> str:
        return graph.op("Clip", value, graph.floats("activation_low", low), graph.floats("activation_high", high))

    return write


def _gelu(graph: GraphWriter, value: str) -> str:
    """x/2 (1 + erf(x / sqrt 2)), the exact form, which is torch's default."""
    bell = graph.op("Erf", graph.op("Mul", value, graph.floats("gelu_scale", math.sqrt(0.5))))
    raised = graph.op("Add", bell, graph.floats("gelu_one", 1.0))
    return graph.op("Mul", graph.op("Mul", value, graph.floats("gelu_half", 0.5)), raised)


def _silu(graph: GraphWriter, value: str) -> str:
    return graph.op("Mul", value, graph.op("Sigmoid", value))


def _mish(graph: GraphWriter, value: str) -> str:
    return graph.op("Mul", value, graph.op("Tanh", graph.op("Softplus", value)))


def _softsign(graph: GraphWriter, value: str) -> str:
    return graph.op("Div", value, graph.op("Add", graph.op("Abs", value), graph.floats("softsign_one", 1.0)))


_ACTIVATION_NODES: dict[str, Callable[[GraphWriter, str], str]] = {
    "tanh": _plain("Tanh"),
    "relu": _plain("Relu"),
    "elu": _plain("Elu", alpha=1.0),
    "gelu": _gelu,
    "leakyrelu": _plain("LeakyRelu", alpha=0.01),
    "silu": _silu,
    "selu": _plain("Selu"),
    "sigmoid": _plain("Sigmoid"),
    "softplus": _plain("Softplus"),
    "softsign": _softsign,
    "mish": _mish,
    "relu6": _clip(0.0, 6.0),
    "hardtanh": _clip(-1.0, 1.0),
    "identity": _plain("Identity"),
}
