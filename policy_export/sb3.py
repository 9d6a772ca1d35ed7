"""From an SB3 `.zip` to a network and layout that can be exported: what the archive shows, what the user adds. Needs torch."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from policy_export.checkpoint import Checkpoint, PolicyLayout
from policy_export.contract import MAX_LAYERS, ActionLayout, TrainingRecord, first_problem
from policy_export.errors import CheckpointError
from policy_export.layout_file import LayoutFile
from policy_export.normalisation import read_statistics
from policy_export.sb3_archive import Sb3Archive, box_limits, box_shape, class_name, open_archive
from policy_export.sb3_network import ACTIVATIONS, ActionMap, Critic, Normalisation, Sb3Config, Sb3Network

_MAX_WIDTH = 8192
_KNOWN_WEIGHT = re.compile(
    r"log_std|(action_net|value_net|critic)\.(weight|bias)|mlp_extractor\.(policy_net|value_net)\.\d+\.(weight|bias)"
    r"|lstm_(actor|critic)\.(weight|bias)_(ih|hh)_l\d+"
)
_POLICY_MODULES = ("stable_baselines3.common.policies", "sb3_contrib.common.recurrent.policies")
_DEFAULT_ACTIVATION = "Tanh"


@dataclass(frozen=True, slots=True)
class Sb3Options:
    """What the user says about an archive. None: take it from the archive.

    `action_low`, `action_high`: the limits of the action space that the policy was trained in. `rescale_action`: the layout's
    limits are another scale for the same actions (as `gymnasium.wrappers.RescaleAction` does), not a mistake.
    """

    statistics: Path | None = None
    activation: str | None = None
    action_low: tuple[float, ...] | None = None
    action_high: tuple[float, ...] | None = None
    squash: bool | None = None
    rescale_action: bool = False


def load_sb3(path: str | Path, layout: LayoutFile, options: Sb3Options | None = None) -> Checkpoint:
    """Read an archive of sb3-contrib's RecurrentPPO (MlpLstmPolicy) or SB3's PPO or A2C (MlpPolicy).

    Raises `CheckpointError` naming what cannot be exported, or the option to give for what cannot be known.
    """
    options = options or Sb3Options()
    archive = open_archive(path)
    _check_policy(archive)
    shapes = {name: tuple(tensor.shape) for name, tensor in archive.weights.items()}
    observation = layout.observation_layout()
    kwargs = _policy_kwargs(archive)
    size = _observation_size(archive, shapes)
    if size != observation.size:
        problem = f"the policy takes {size} values, the layout describes {observation.size}"
        raise CheckpointError(f"{path}: {problem}; describe its observation in a YAML file and give it as --layout")
    hidden, layers = _memory(archive, shapes)
    activation = _activation(archive, options, kwargs, shapes)
    actions, action = _actions(archive, shapes, layout, options, kwargs)
    config = Sb3Config(
        observation_size=size,
        memory="lstm" if layers else "none",
        hidden_size=hidden,
        layers=max(1, layers),
        critic=_critic(shapes, layers),
        pi=_widths(archive, shapes, "policy_net"),
        vf=_widths(archive, shapes, "value_net"),
        activation=activation,
        actions=actions,
        normalisation=None if options.statistics is None else Normalisation(*read_statistics(options.statistics, size)),
    )
    network = _network(archive, config)
    policy_layout = PolicyLayout(observation=observation, action=action, rate_hz=layout.rate_hz, reset=layout.reset)
    return Checkpoint(network, policy_layout, _training(archive, config))


def _check_policy(archive: Sb3Archive) -> None:
    """Refuse what would compute something else than the layers that are rebuilt here."""
    unknown = sorted(name for name in archive.weights if not _KNOWN_WEIGHT.fullmatch(name))
    needed = {"action_net.weight", "action_net.bias"} - archive.weights.keys()
    if unknown or needed:
        what = f"has weights called {', '.join(unknown[:3])}" if unknown else "has no action_net"
        wanted = "MlpLstmPolicy (RecurrentPPO) and MlpPolicy (PPO, A2C) with the default feature extractor can be exported"
        raise CheckpointError(f"{archive.path}: {what}; only {wanted}")
    policy = archive.data.get("policy_class")
    module = policy.get("__module__") if isinstance(policy, dict) else None
    if module is not None and module not in _POLICY_MODULES:
        problem = f"its policy class is of {str(module)[:80]}, and what that computes cannot be read from weights"
        raise CheckpointError(f"{archive.path}: {problem}; train with MlpLstmPolicy or MlpPolicy itself")
    kwargs = _policy_kwargs(archive)
    extractor = class_name(kwargs.get("features_extractor_class", "FlattenExtractor"))
    if extractor.rpartition(".")[2] != "FlattenExtractor":
        raise CheckpointError(
            f"{archive.path}: features_extractor_class {extractor[:80]} cannot be exported, only the default one"
        )
    lstm = kwargs.get("lstm_kwargs") or {}
    if not isinstance(lstm, dict) or lstm.keys() - {"dropout", "bias"}:
        raise CheckpointError(f"{archive.path}: lstm_kwargs {str(lstm)[:80]}: only dropout and bias can be exported")


def _policy_kwargs(archive: Sb3Archive) -> Mapping[str, Any]:
    kwargs = archive.data.get("policy_kwargs")
    return kwargs if isinstance(kwargs, dict) else {}


def _shape(archive: Sb3Archive, shapes: Mapping[str, tuple[int, ...]], name: str) -> tuple[int, int]:
    shape = shapes.get(name)
    if shape is None or len(shape) != 2 or not all(0 < size <= 4 * _MAX_WIDTH for size in shape):
        raise CheckpointError(f"{archive.path}: policy.pth: {name} is missing or has the shape {shape}")
    return shape[0], shape[1]


def _memory(archive: Sb3Archive, shapes: Mapping[str, tuple[int, ...]]) -> tuple[int, int]:
    """Hidden size and number of layers; 0 layers without memory (the hidden size is then unused)."""
    layers = sum(name.startswith("lstm_actor.weight_ih_l") for name in shapes)
    if not layers:
        return 0, 0
    if layers > MAX_LAYERS:
        raise CheckpointError(f"{archive.path}: has {layers} LSTM layers, at most {MAX_LAYERS} can be exported")
    return _shape(archive, shapes, "lstm_actor.weight_hh_l0")[1], layers


def _observation_size(archive: Sb3Archive, shapes: Mapping[str, tuple[int, ...]]) -> int:
    """Values of one observation, flattened; from the first layer that takes them, checked against the stated space."""
    shape = box_shape(archive, "observation_space")
    space = archive.data.get("observation_space")
    if isinstance(space, dict) and "Box" not in str(space.get(":type:", "Box")):
        raise CheckpointError(
            f"{archive.path}: observation space {class_name(space.get(':type:'))[:80]} cannot be exported, only Box"
        )
    if shape is not None and len(shape) == 3 and space is not None and space.get("dtype") == "uint8":
        raise CheckpointError(f"{archive.path}: image observations cannot be exported, only Box vectors")
    first = next(n for n in ("lstm_actor.weight_ih_l0", "mlp_extractor.policy_net.0.weight", "action_net.weight") if n in shapes)
    size = _shape(archive, shapes, first)[1]
    if shape is not None and math.prod(shape) != size:
        raise CheckpointError(f"{archive.path}: observation_space holds {math.prod(shape)} values, the weights take {size}")
    return size


def _critic(shapes: Mapping[str, tuple[int, ...]], layers: int) -> Critic:
    if "value_net.weight" not in shapes:
        return "none"
    if not layers or not {"lstm_critic.weight_ih_l0", "critic.weight"} & shapes.keys():
        return "shared"
    return "separate" if "lstm_critic.weight_ih_l0" in shapes else "linear"


def _widths(archive: Sb3Archive, shapes: Mapping[str, tuple[int, ...]], part: str) -> tuple[int, ...]:
    """Sizes of the hidden layers. They are at even places, an activation between any two."""
    prefix = f"mlp_extractor.{part}."
    places = sorted({int(name.removeprefix(prefix).split(".")[0]) for name in shapes if name.startswith(prefix)})
    if places != [2 * k for k in range(len(places))]:
        raise CheckpointError(f"{archive.path}: policy.pth: {part} is not one linear layer and one plain activation in turn")
    return tuple(_shape(archive, shapes, f"{prefix}{place}.weight")[0] for place in places)


def _activation(
    archive: Sb3Archive, options: Sb3Options, kwargs: Mapping[str, Any], shapes: Mapping[str, tuple[int, ...]]
) -> str:
    choices = f"one of {', '.join(ACTIVATIONS)}"
    if options.activation is not None:
        if options.activation.lower() not in ACTIVATIONS:
            raise CheckpointError(f"--activation {options.activation}: give {choices}")
        return options.activation.lower()
    if not any(name.startswith("mlp_extractor.") for name in shapes):
        return "identity"
    if "policy_kwargs" not in archive.data:
        raise CheckpointError(f"{archive.path}: does not say its activation; give --activation, {choices}")
    stated = class_name(kwargs.get("activation_fn", _DEFAULT_ACTIVATION))
    if stated.lower() not in ACTIVATIONS:
        raise CheckpointError(f"{archive.path}: activation_fn {stated[:80]} is not known here; give --activation, {choices}")
    return stated.lower()


def _actions(
    archive: Sb3Archive,
    shapes: Mapping[str, tuple[int, ...]],
    layout: LayoutFile,
    options: Sb3Options,
    kwargs: Mapping[str, Any],
) -> tuple[ActionMap, ActionLayout]:
    count = _shape(archive, shapes, "action_net.weight")[0]
    entry = layout.action
    if count != len(entry.order):
        problem = f"the policy has {count} actions, the layout names {len(entry.order)} ({', '.join(entry.order)})"
        raise CheckpointError(f"{archive.path}: {problem}; name them in the --layout file under action.order")
    low, high = _space(archive, options, count)
    to_low = low if entry.low is None else np.array(entry.low)
    to_high = high if entry.high is None else np.array(entry.high)
    same = np.allclose(low, to_low, rtol=0.0, atol=1e-7) and np.allclose(high, to_high, rtol=0.0, atol=1e-7)
    if not same and not options.rescale_action:
        problem = f"the layout's action limits are not the action space's, {low.tolist()} to {high.tolist()}"
        raise CheckpointError(
            f"{archive.path}: {problem}; correct them, or give --rescale-action if they are another scale of the same"
        )
    if same:
        to_low, to_high = low, high
    places = tuple(entry.names.index(name) for name in entry.order)
    squash = _squash(archive, options, kwargs)
    actions = ActionMap(low, high, to_low, to_high, places, len(entry.names), squash)
    full = [np.zeros(len(entry.names)) for _ in range(2)]
    full[0][list(places)], full[1][list(places)] = to_low, to_high
    try:
        return actions, ActionLayout.model_validate(
            {"frame": entry.frame, "names": entry.names, "low": tuple(full[0].tolist()), "high": tuple(full[1].tolist())}
        )
    except ValidationError as error:
        raise CheckpointError(f"{archive.path}: action: {first_problem(error)[1]}; correct action in the --layout file") from None


def _space(archive: Sb3Archive, options: Sb3Options, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Limits of the action space that the policy was trained in."""
    space = archive.data.get("action_space")
    if isinstance(space, dict) and "Box" not in str(space.get(":type:", "Box")):
        raise CheckpointError(f"{archive.path}: action space {class_name(space.get(':type:'))[:80]} cannot be exported, only Box")
    stated = box_limits(archive, "action_space")
    if options.action_low is None or options.action_high is None:
        if stated is None or stated[0].size != count:
            raise CheckpointError(f"{archive.path}: does not show its action space; give --action-low and --action-high")
        low, high = stated
    else:
        low, high = np.array(options.action_low), np.array(options.action_high)
        if low.size != count or high.size != count:
            raise CheckpointError(f"--action-low, --action-high: give {count} values each, the policy has {count} actions")
        if stated is not None and not (np.allclose(low, stated[0]) and np.allclose(high, stated[1])):
            problem = f"the archive's action space is {stated[0].tolist()} to {stated[1].tolist()}"
            raise CheckpointError(f"--action-low, --action-high: {problem}; leave them out (another scale is given by --layout)")
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        problem = "limits must be finite and every low below its high"
        raise CheckpointError(f"{archive.path}: action space {low.tolist()} .. {high.tolist()}: {problem}")
    return low, high


def _squash(archive: Sb3Archive, options: Sb3Options, kwargs: Mapping[str, Any]) -> bool:
    if options.squash is not None:
        return options.squash
    if "policy_kwargs" not in archive.data:
        raise CheckpointError(f"{archive.path}: does not say whether it squashes its actions; give --squash or --clip")
    stated = kwargs.get("squash_output", False)
    if not isinstance(stated, bool):
        raise CheckpointError(f"{archive.path}: squash_output is {str(stated)[:40]}; give --squash or --clip")
    return stated


def _network(archive: Sb3Archive, config: Sb3Config) -> Sb3Network:
    network = Sb3Network(config)
    bias_free = (_policy_kwargs(archive).get("lstm_kwargs") or {}).get("bias") is False
    missing = [n for n in network.state_dict() if n not in archive.weights and not (bias_free and "lstm_actor.bias" in n)]
    if missing:
        raise CheckpointError(f"{archive.path}: policy.pth lacks {', '.join(missing[:3])}")
    try:
        network.load_weights({name: tensor.float() for name, tensor in archive.weights.items()})
    except (RuntimeError, TypeError) as error:
        raise CheckpointError(f"{archive.path}: weights do not fit together ({' '.join(str(error).split())[:200]})") from None
    return network.eval().requires_grad_(requires_grad=False)


def _training(archive: Sb3Archive, config: Sb3Config) -> TrainingRecord:
    seed, steps = archive.data.get("seed"), archive.data.get("num_timesteps")
    kind = "MlpLstmPolicy" if config.memory == "lstm" else "MlpPolicy"
    return TrainingRecord(
        seed=seed if type(seed) is int else None,
        steps=steps if type(steps) is int and steps >= 0 else None,
        details={
            "trainer": f"stable-baselines3 {archive.version}",
            "policy": kind,
            "critic": config.critic,
            "net_arch": {"pi": list(config.pi), "vf": list(config.vf)},
            "activation": config.activation,
            "squash": config.actions.squash,
            "normalised": config.normalisation is not None,
            "action_space": {"low": config.actions.low.tolist(), "high": config.actions.high.tolist()},
        },
    )
