"""Export: what is written is what was trained, and nothing is written otherwise."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from policy_samples import LAYOUT, make_checkpoint, make_network, save_checkpoint

from policy_export import cli, export
from policy_export.checkpoint import load_checkpoint
from policy_export.errors import CheckpointError, PolicyError, VerificationError
from policy_export.network import PolicyNetwork
from policy_export.policy_file import read_policy_file
from policy_export.verify import TOLERANCE, verify_consistency, verify_file


@pytest.fixture(scope="module")
def checkpoint_path(network: PolicyNetwork, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_checkpoint(network, tmp_path_factory.mktemp("run") / "last.pt")


@pytest.mark.parametrize(
    ("config", "form"),
    [
        ({}, "fused"),
        ({"preprocessing": "channels"}, "gates"),
        ({"feature_skip": False, "hidden_size": 24, "head_size": 16}, "gates"),
        ({"feature_skip": False, "hidden_size": 24, "head_size": 16}, "fused"),
        ({"memory": "none", "preprocessing": "channels"}, "gates"),
        ({"memory": "gru"}, "gates"),
        ({"action_low": (-2.0, -1.0, -1.0, -2.0), "action_high": (3.0, 1.0, 1.0, 2.0)}, "gates"),
    ],
    ids=str,
)
def test_every_network_is_exported_within_the_tolerance(config: dict, form: str, tmp_path: Path) -> None:
    network = make_network(5, **config)
    layout = LAYOUT
    if "action_low" in config:
        action = LAYOUT.action.model_copy(update={"low": config["action_low"], "high": config["action_high"]})
        layout = LAYOUT.model_copy(update={"action": action})
    checkpoint = make_checkpoint(network)
    checkpoint = type(checkpoint)(network, layout, checkpoint.training)
    metadata = export.export_policy(checkpoint, tmp_path / "policy.onnx", memory_form=form)
    assert metadata.verification.steps == 1000
    assert metadata.verification.resets > 20
    assert 0.0 < metadata.verification.max_abs_difference <= TOLERANCE
    assert metadata.action.high == network.config.action_high
    assert verify_consistency(tmp_path / "policy.onnx", steps=200) < 1e-5


def test_a_memory_that_no_file_can_carry_is_refused_by_name(tmp_path: Path) -> None:
    network = make_network(memory="stack", stack_frames=4)
    with pytest.raises(PolicyError, match=r"memory `stack` is for comparison in training"):
        export.export_policy(make_checkpoint(network), tmp_path / "policy.onnx")
    assert list(tmp_path.iterdir()) == []


def test_the_file_is_a_standard_small_and_single_onnx_file(policy_path: Path) -> None:
    model = onnx.load(policy_path, load_external_data=False)
    onnx.checker.check_model(model, full_check=True)
    assert policy_path.stat().st_size < 1_000_000
    assert {port.name for port in model.graph.input} == {"obs", "h_in", "c_in"}
    assert {port.name for port in model.graph.output} == {"action", "h_out", "c_out", "value"}
    assert model.graph.input[0].type.tensor_type.shape.dim[0].dim_param == "batch"


def test_export_is_reproducible_and_tells_nothing_of_this_machine(
    network: PolicyNetwork, policy_path: Path, tmp_path: Path
) -> None:
    export.export_policy(make_checkpoint(network), tmp_path / "again.onnx", name="test")
    assert (tmp_path / "again.onnx").read_bytes() == policy_path.read_bytes()
    assert str(Path.cwd()).encode() not in policy_path.read_bytes()
    assert str(Path.home()).encode() + b"/" not in policy_path.read_bytes()


def test_a_graph_that_computes_something_else_is_not_written(
    network: PolicyNetwork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exporter is given the graph of a network whose weights differ by 0.001 in one place."""
    output = tmp_path / "policy.onnx"
    output.write_bytes(b"the old file")
    build = export.build_model

    def other(trained: PolicyNetwork, form: str) -> onnx.ModelProto:
        changed = make_network()
        changed.load_state_dict(trained.state_dict())
        with torch.no_grad():
            changed.policy_head[2].bias[0] += 1e-3
        return build(changed, form)

    monkeypatch.setattr(export, "build_model", other)
    with pytest.raises(VerificationError, match="nothing was written"):
        export.export_policy(make_checkpoint(network), output)
    assert output.read_bytes() == b"the old file"
    assert [path.name for path in tmp_path.iterdir()] == ["policy.onnx"]


def test_a_file_of_other_weights_fails_verification_against_a_checkpoint(policy_path: Path, network: PolicyNetwork) -> None:
    assert verify_file(policy_path, network, steps=200).max_action_difference < 1e-5
    with pytest.raises(VerificationError, match="exceeds"):
        verify_file(policy_path, make_network(99), steps=50)
    with pytest.raises(VerificationError, match="another network"):
        verify_file(policy_path, make_network(memory="none"), steps=50)


def test_checkpoint_round_trip(network: PolicyNetwork, checkpoint_path: Path) -> None:
    loaded = load_checkpoint(checkpoint_path)
    assert loaded.layout == LAYOUT
    assert loaded.training.details == {"preset": "test"}
    for name, tensor in network.state_dict().items():
        torch.testing.assert_close(loaded.network.state_dict()[name], tensor, rtol=0, atol=0)


def _change(path: Path, target: Path, **changes: object) -> Path:
    torch.save(torch.load(path, weights_only=True) | changes, target)
    return target


def test_checkpoints_that_cannot_be_used(checkpoint_path: Path, tmp_path: Path) -> None:
    target = tmp_path / "bad.pt"
    good = torch.load(checkpoint_path, weights_only=True)
    wrong_limits = good["layout"] | {"action": good["layout"]["action"] | {"high": [2.0, 0.5, 0.5, 1.0]}}
    not_finite = {name: torch.full_like(tensor, np.nan) for name, tensor in good["state_dict"].items()}
    cases = [
        ({"network_config": good["network_config"] | {"hidden_size": 64}}, "do not fit"),
        ({"network_config": good["network_config"] | {"magic": 1}}, "magic"),
        ({"layout": wrong_limits}, "limits differ"),
        ({"layout": {}}, "observation"),
        ({"state_dict": not_finite}, "NaN"),
        ({"training": {"seed": "x"}}, "seed"),
        ({"training": 5}, "dict"),
    ]
    for changes, word in cases:
        with pytest.raises(CheckpointError, match=word) as caught:
            load_checkpoint(_change(checkpoint_path, target, **changes))
        assert "\n" not in str(caught.value)
    for content in (b"", b"junk", checkpoint_path.read_bytes()[:5000]):
        target.write_bytes(content)
        with pytest.raises(CheckpointError, match="not a readable checkpoint"):
            load_checkpoint(target)
    with pytest.raises(CheckpointError, match="no such file"):
        load_checkpoint(tmp_path / "absent.pt")
    torch.save({"state_dict": {}}, target)
    with pytest.raises(CheckpointError, match="lacks network_config"):
        load_checkpoint(target)


@settings(max_examples=60, deadline=None)
@given(keep=st.floats(0.0, 1.0, exclude_max=True), place=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(0, 255))
def test_a_damaged_checkpoint_is_an_error_of_ours_or_still_whole(
    checkpoint_path: Path, keep: float, place: float, flip: int
) -> None:
    data = bytearray(checkpoint_path.read_bytes())
    data[int(place * len(data))] ^= flip
    damaged_path = checkpoint_path.with_name("damaged.pt")
    for content in (data, data[: int(keep * len(data))]):
        damaged_path.write_bytes(content)
        try:
            loaded = load_checkpoint(damaged_path)
        except CheckpointError:
            continue
        assert all(torch.isfinite(tensor).all() for tensor in loaded.network.state_dict().values())


class _Trap:
    """Unpickling this would create a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return (Path.touch, (self.path,))


def test_a_checkpoint_cannot_run_code(tmp_path: Path) -> None:
    torch.save({"network_config": _Trap(tmp_path / "ran")}, tmp_path / "trap.pt")
    with pytest.raises(CheckpointError):
        load_checkpoint(tmp_path / "trap.pt")
    assert not (tmp_path / "ran").exists()


def run_cli(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "policy_export", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_command_line_from_checkpoint_to_inspected_file(checkpoint_path: Path, tmp_path: Path) -> None:
    results = tmp_path / "results.json"
    results.write_text(json.dumps({"success": {"rate": 0.96, "low": 0.92, "high": 0.98, "n": 200}}))
    file = tmp_path / "policy.onnx"
    done = run_cli(checkpoint_path, "-o", file, "--evaluation", results, "--json")
    assert done.returncode == 0, done.stderr
    written = json.loads(done.stdout)
    assert written["metadata"]["evaluation"]["success"]["n"] == 200
    assert written["metadata"]["training"]["seed"] == 3
    assert written["sha256"] == read_policy_file(file).sha256
    checked = run_cli("verify", file, "--checkpoint", checkpoint_path, "--json")
    assert json.loads(checked.stdout)["measured"]["max_abs_difference"] <= TOLERANCE


def test_inspect_verify_and_bench(policy_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    outputs = {}
    for command in (["inspect"], ["verify", "--steps", "100"], ["bench", "--steps", "200"]):
        with pytest.raises(SystemExit) as caught:
            cli.main([command[0], str(policy_path), *command[1:]])
        assert caught.value.code == 0
        outputs[command[0]] = capsys.readouterr().out
    for word in ("goal_offset", "20 Hz", "-0.5 to 1 m/s", "seed 3", "offboard_entry"):
        assert word in outputs["inspect"]
    assert "agree within" in outputs["verify"]
    assert "runner to bare onnxruntime" in outputs["bench"]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["absent.pt", "-o", "x.onnx"], "no such file"),
        (["inspect", "absent.onnx"], "cannot read"),
        (["verify", "setup.zip"], "refused"),
        (["absent.pt", "-o", "x.onnx", "--evaluation", "absent.json"], "cannot read"),
    ],
)
def test_mistakes_cost_one_line_and_exit_code_2(
    arguments: list[str], word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with zipfile.ZipFile("setup.zip", "w") as archive:
        archive.writestr("data", "x")
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    assert caught.value.code == 2
    shown = capsys.readouterr()
    errors = [line for line in shown.err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert word in errors[0]
    assert "Traceback" not in shown.err
    assert shown.out == ""
    assert not Path("x.onnx").exists()


def test_missing_folder_and_bad_evaluation(checkpoint_path: Path, tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match="no such folder"):
        export.export_checkpoint(checkpoint_path, tmp_path / "nowhere" / "x.onnx")
    (tmp_path / "list.json").write_text("[1]")
    with pytest.raises(PolicyError, match="one JSON object"):
        export.read_evaluation(tmp_path / "list.json")


def test_help_is_quick_to_load_and_has_examples() -> None:
    code = "import sys, policy_export.cli as c\ntry: c.main(['--help'])\nexcept SystemExit: print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert "Examples:" in done.stdout
    assert done.stdout.strip().endswith("False")
