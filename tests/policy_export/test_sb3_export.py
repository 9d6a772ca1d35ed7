"""Models of Stable-Baselines3 and sb3-contrib: the file answers what `model.predict` answers."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from gymnasium.wrappers import RescaleAction
from sb3_samples import HIGH, LAYOUT, LOW, SETTINGS, SIZE, Follow, Setting, Trained, largest_differences, train
from stable_baselines3 import PPO

from policy_export.errors import PolicyFileError
from policy_export.export import export_checkpoint, load_any
from policy_export.policy_file import read_policy_file
from policy_export.runner import PolicyRunner, open_session
from policy_export.sb3 import Sb3Options
from policy_export.sb3_graph import build_sb3_model
from policy_export.sb3_network import ACTIVATIONS, Sb3Network
from policy_export.verify import TOLERANCE

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "export_sb3.md"


@pytest.fixture(scope="session")
def layout_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("layout") / "layout.yaml"
    path.write_text(LAYOUT)
    return path


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    torch.set_num_threads(1)
    return train(SETTINGS["gelu, VecNormalize"], tmp_path_factory.mktemp("sb3"))


@pytest.mark.parametrize("name", SETTINGS)
def test_the_file_answers_what_predict_answers(name: str, layout_path: Path, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    setting = SETTINGS[name]
    trained = train(setting, tmp_path)
    path = tmp_path / "policy.onnx"
    metadata = export_checkpoint(trained.archive, path, layout=layout_path, options=Sb3Options(statistics=trained.statistics))
    action, state = largest_differences(trained, path)
    assert action <= TOLERANCE
    assert state <= 1e-4
    assert metadata.verification.max_abs_difference <= TOLERANCE
    assert metadata.verification.steps == 1000
    np.testing.assert_allclose(metadata.action.low, setting.low, rtol=1e-7)
    assert metadata.layers == setting.kwargs.get("n_lstm_layers", 1)
    assert metadata.training.steps == 2048
    own_critic = setting.recurrent and setting.kwargs.get("enable_critic_lstm", True)
    assert ("value" in {port.name for port in read_policy_file(path).model.outputs}) == (not own_critic)


def test_the_value_is_sb3s_own(layout_path: Path, tmp_path: Path) -> None:
    for name in ("shared LSTM, tanh, list", "no critic LSTM, relu, dict", "mlp"):
        setting = SETTINGS[name]
        trained = train(setting, tmp_path, steps=512)
        export_checkpoint(trained.archive, tmp_path / "policy.onnx", layout=layout_path)
        runner = PolicyRunner.load(tmp_path / "policy.onnx", allow_foreign=True)
        observation = np.linspace(-3.0, 4.0, SIZE, dtype=np.float32)
        runner.step(observation)
        tensor, zeros = torch.from_numpy(observation)[None], torch.zeros(1, 1, 24)
        extra = ((zeros, zeros), torch.zeros(1)) if setting.recurrent else ()
        with torch.no_grad():
            wanted = trained.model.policy.predict_values(tensor, *extra).item()
        assert runner.value == pytest.approx(wanted, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_every_activation(activation: str, layout_path: Path, tmp_path: Path) -> None:
    """Untrained, with uneven weights; one batch is enough, as nothing is remembered."""
    function = {name.lower(): getattr(torch.nn, name) for name in dir(torch.nn)}[activation]
    model = PPO("MlpPolicy", Follow(), policy_kwargs={"activation_fn": function}, seed=2)
    assert model.policy.mlp_extractor.policy_net[1].__class__ is function
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    model.save(tmp_path / "model.zip")
    network = load_any(tmp_path / "model.zip", layout_path).network
    assert isinstance(network, Sb3Network)
    observations = np.random.default_rng(0).normal(size=(300, SIZE)).astype(np.float32)
    session = open_session(build_sb3_model(network).SerializeToString())
    found = session.run(["action"], {"obs": observations})[0]
    wanted = model.predict(observations, deterministic=True)[0]
    assert (np.ptp(wanted, axis=0) > 0.1).sum() >= 2
    np.testing.assert_allclose(found, wanted, atol=TOLERANCE, rtol=0)


def test_both_forms_of_the_memory_and_several_layers(layout_path: Path, tmp_path: Path) -> None:
    trained = train(SETTINGS["two layers, elu"], tmp_path, steps=512)
    export_checkpoint(trained.archive, tmp_path / "fused.onnx", layout=layout_path, memory_form="fused")
    model = onnx.load(tmp_path / "fused.onnx")
    assert [node.op_type for node in model.graph.node].count("LSTM") == 2
    assert [d.dim_value for d in model.graph.input[1].type.tensor_type.shape.dim] == [2, 0, 24]
    assert largest_differences(trained, tmp_path / "fused.onnx")[0] <= TOLERANCE
    runner = PolicyRunner.load(tmp_path / "fused.onnx", allow_foreign=True)
    assert runner.hidden_state[0].shape == (2, 24)


def test_actions_trained_on_another_scale_come_out_in_si_units(layout_path: Path, tmp_path: Path) -> None:
    """What `RescaleAction` does in training is in the file: it answers in the units of the inner environment."""
    ones = (-1.0,) * 4, (1.0,) * 4
    trained = train(Setting(low=ones[0], high=ones[1], recurrent=False), tmp_path, steps=512)
    layout = tmp_path / "scaled.yaml"
    layout.write_text(f"{LAYOUT}action: {{low: {list(LOW)}, high: {list(HIGH)}}}\n")
    export_checkpoint(trained.archive, tmp_path / "p.onnx", layout=layout, options=Sb3Options(rescale_action=True))
    runner, wrapper = PolicyRunner.load(tmp_path / "p.onnx", allow_foreign=True), RescaleAction(Follow(), *map(np.float32, ones))
    for k in range(50):
        observation = np.random.default_rng(k).normal(scale=5.0, size=SIZE).astype(np.float32)
        wanted = wrapper.action(trained.model.predict(observation, deterministic=True)[0])
        np.testing.assert_allclose(runner.step(observation), wanted, atol=1e-5)


def test_fewer_actions_are_put_in_their_places(tmp_path: Path) -> None:
    trained = train(Setting(low=(-1.0, -0.5), high=(1.0, 0.5), recurrent=False), tmp_path, steps=512)
    (tmp_path / "l.yaml").write_text(f"{LAYOUT}action: {{order: [yaw_rate, vx], frame: corridor}}\n")
    metadata = export_checkpoint(trained.archive, tmp_path / "p.onnx", layout=tmp_path / "l.yaml")
    assert metadata.action.low == (-0.5, 0.0, 0.0, -1.0)
    observation = np.linspace(-3.0, 4.0, SIZE, dtype=np.float32)
    turn, ahead = trained.model.predict(observation, deterministic=True)[0]
    found = PolicyRunner.load(tmp_path / "p.onnx", allow_foreign=True).step(observation)
    np.testing.assert_allclose(found, [ahead, 0.0, 0.0, turn], atol=1e-6)


def test_any_observation_and_action_can_be_carried_but_not_flown(tmp_path: Path) -> None:
    trained = train(Setting(low=(-200.0,) * 3, high=(300.0,) * 3), tmp_path, steps=512)
    action = "action: {frame: none, order: [other_a, other_b, other_c]}"
    (tmp_path / "l.yaml").write_text(f"observation: [{{name: other, size: {SIZE}, unit: mixed}}]\n{action}\n")
    metadata = export_checkpoint(trained.archive, tmp_path / "p.onnx", layout=tmp_path / "l.yaml")
    assert metadata.action.size == 3
    assert largest_differences(trained, tmp_path / "p.onnx", steps=100)[0] <= 1e-4
    with pytest.raises(PolicyFileError, match=r"metadata\.observation\.channels\.0\.name other"):
        PolicyRunner.load(tmp_path / "p.onnx")


def test_command_line_from_archive_to_checked_file(trained: Trained, layout_path: Path, tmp_path: Path) -> None:
    def run(*arguments: object) -> str:
        command = [sys.executable, "-m", "policy_export", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout

    file, extra = tmp_path / "policy.onnx", ("--normalize", trained.statistics)
    run(trained.archive, "-o", file, "--layout", layout_path, *extra)
    details = json.loads(run("inspect", file, "--json"))["metadata"]["training"]["details"]
    assert details["normalised"] is True
    assert details["activation"] == "gelu"
    checked = json.loads(run("verify", file, "--checkpoint", trained.archive, *extra, "--json"))
    assert checked["measured"]["max_abs_difference"] <= TOLERANCE
    for text in (run("bench", file, "--steps", "100"), run("inspect", file)):
        assert text


def test_statistics_written_as_documented(trained: Trained, tmp_path: Path) -> None:
    """The snippet of docs/export_sb3.md, run on a VecNormalize saved by SB3 itself, in a process of its own."""
    assert trained.normaliser is not None
    assert trained.statistics is not None
    trained.normaliser.save(str(tmp_path / "vecnormalize.pkl"))
    snippet = re.search(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    assert snippet is not None
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n{snippet[1]}"
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, timeout=120, check=True)
    found, wanted = np.load(tmp_path / "stats.npz"), np.load(trained.statistics)
    for name in ("mean", "var", "clip_obs", "epsilon"):
        np.testing.assert_array_equal(found[name], wanted[name])
