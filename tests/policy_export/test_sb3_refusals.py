"""Archives, statistics and layouts that cannot be used: nothing in them runs or unfolds, and the message says what to do."""

from __future__ import annotations

import base64
import io
import json
import pickle
import resource
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sb3_samples import LAYOUT, LOW, SETTINGS, SIZE, train

from policy_export import cli
from policy_export.errors import CheckpointError
from policy_export.export import export_checkpoint, load_any
from policy_export.sb3 import Sb3Options
from strict_yaml import ConfigError

Change = Callable[[dict[str, bytes]], None]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """model.zip (recurrent, VecNormalize), stats.npz and layout.yaml."""
    folder = tmp_path_factory.mktemp("sb3")
    train(SETTINGS["gelu, VecNormalize"], folder, steps=512)
    (folder / "layout.yaml").write_text(LAYOUT)
    return folder


def changed(folder: Path, target: Path, change: Change, **options: Any) -> Path:
    """The archive with its entries changed."""
    with zipfile.ZipFile(folder / "model.zip") as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    change(entries)
    with zipfile.ZipFile(target, "w", **options) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return target


def data(**values: Any) -> Change:
    """Change values in `data`; a dict is merged into the one that is there, None removes the key."""

    def change(entries: dict[str, bytes]) -> None:
        content = json.loads(entries["data"])
        for name, value in values.items():
            if value is None:
                del content[name]
            else:
                content[name] = content[name] | value if isinstance(value, dict) else value
        entries["data"] = json.dumps(content).encode()

    return change


def weights(change: Callable[[dict[str, torch.Tensor]], Any]) -> Change:
    def apply(entries: dict[str, bytes]) -> None:
        state = torch.load(io.BytesIO(entries["policy.pth"]), weights_only=True)
        change(state)
        stream = io.BytesIO()
        torch.save(state, stream)
        entries["policy.pth"] = stream.getvalue()

    return apply


class Trap:
    """Unpickling this would create a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return (Path.touch, (self.path,))


def pickled(value: object) -> str:
    return base64.b64encode(pickle.dumps(value)).decode()


def test_nothing_in_an_archive_is_run(folder: Path, tmp_path: Path) -> None:
    """Every pickle in `data` is replaced by one that would leave a mark; the export succeeds and none does."""

    def trap(entries: dict[str, bytes]) -> None:
        content = json.loads(entries["data"])
        for name, value in content.items():
            if isinstance(value, dict) and ":serialized:" in value and name != "action_space":
                value[":serialized:"] = pickled(Trap(tmp_path / f"ran_{name}"))
        # Appended to the Box's own bytes, so that its limits are still found.
        box = base64.b64decode(content["action_space"][":serialized:"])
        joined = pickle.dumps(Trap(tmp_path / "ran_box"))[:-1] + box
        content["action_space"][":serialized:"] = base64.b64encode(joined).decode()
        entries["data"] = json.dumps(content).encode()
        entries["pytorch_variables.pth"] = pickle.dumps(Trap(tmp_path / "ran_variables"))

    path = changed(folder, tmp_path / "trap.zip", trap)
    metadata = export_checkpoint(path, tmp_path / "policy.onnx", layout=folder / "layout.yaml")
    assert metadata.action.low == pytest.approx(LOW)
    assert not list(tmp_path.glob("ran_*"))


def test_a_pickle_in_place_of_the_weights_is_refused(folder: Path, tmp_path: Path) -> None:
    def with_torch(entries: dict[str, bytes]) -> None:
        stream = io.BytesIO()
        torch.save({"action_net.weight": Trap(tmp_path / "ran")}, stream)
        entries["policy.pth"] = stream.getvalue()

    def bare(entries: dict[str, bytes]) -> None:
        entries["policy.pth"] = pickle.dumps(Trap(tmp_path / "ran"))

    for change in (with_torch, bare):
        with pytest.raises(CheckpointError, match="no readable weights"):
            load_any(changed(folder, tmp_path / "trap.zip", change), folder / "layout.yaml")
    assert not (tmp_path / "ran").exists()


def test_statistics_are_never_unpickled(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "vecnormalize.pkl").write_bytes(pickle.dumps(Trap(tmp_path / "ran")))
    np.savez(tmp_path / "objects.npz", mean=np.array([Trap(tmp_path / "ran")], dtype=object), var=1, clip_obs=1, epsilon=1)
    for name in ("vecnormalize.pkl", "objects.npz"):
        with pytest.raises(CheckpointError, match=r"docs/export_sb3\.md"):
            load_any(folder / "model.zip", folder / "layout.yaml", Sb3Options(statistics=tmp_path / name))
    assert not (tmp_path / "ran").exists()


def bomb(name: str, size: int) -> Change:
    return lambda entries: entries.update({name: b" " * size})


def packed_weights(entries: dict[str, bytes]) -> None:
    """policy.pth whose inner entries are packed: 300 MB of zeros in 300 kB."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as inner:
        inner.writestr("archive/data.pkl", b"x")
        inner.writestr("archive/data/0", bytes(300_000_000))
    entries["policy.pth"] = stream.getvalue()


def endless_view(state: dict[str, torch.Tensor]) -> None:
    state["action_net.weight"] = torch.zeros(1).expand(10**6, 10**6)


def many_entries(entries: dict[str, bytes]) -> None:
    entries.update({f"part{k}": b"" for k in range(300)})


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (bomb("policy.pth", 300 * 2**20), "unpacks to more than"),
        (bomb("data", 80 * 2**20), "unpacks to more than"),
        (packed_weights, "packed in a way"),
        (weights(endless_view), "more than"),
        (many_entries, "entries"),
    ],
    ids=["policy.pth", "data", "inner", "view", "entries"],
)
def test_bombs_do_not_go_off(change: Change, word: str, folder: Path, tmp_path: Path) -> None:
    path = changed(folder, tmp_path / "bomb.zip", change, compression=zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 2_000_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CheckpointError, match=word):
        load_any(path, folder / "layout.yaml")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 600 * 1024


def test_a_bomb_of_statistics(folder: Path, tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "stats.npz", mean=np.zeros(10**8), var=1, clip_obs=1, epsilon=1)
    with pytest.raises(CheckpointError, match="unpacks to more than"):
        load_any(folder / "model.zip", folder / "layout.yaml", Sb3Options(statistics=tmp_path / "stats.npz"))


@settings(max_examples=60, deadline=None)
@given(keep=st.floats(0.0, 1.0, exclude_max=True), place=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(1, 255))
def test_a_damaged_archive_is_an_error_of_ours_or_still_whole(folder: Path, keep: float, place: float, flip: int) -> None:
    whole = bytearray((folder / "model.zip").read_bytes())
    whole[int(place * len(whole))] ^= flip
    for content in (whole, whole[: int(keep * len(whole))]):
        (folder / "damaged.zip").write_bytes(content)
        try:
            loaded = load_any(folder / "damaged.zip", folder / "layout.yaml")
        except CheckpointError:
            continue
        assert all(torch.isfinite(tensor).all() for tensor in loaded.network.state_dict().values())


def not_finite(state: dict[str, torch.Tensor]) -> None:
    state["action_net.bias"][0] = float("nan")


def other_sizes(state: dict[str, torch.Tensor]) -> None:
    state["action_net.weight"] = torch.zeros(4, 5)


def extractor(state: dict[str, torch.Tensor]) -> None:
    state["features_extractor.cnn.0.weight"] = torch.zeros(3)


def no_data(entries: dict[str, bytes]) -> None:
    del entries["data"]


NAMED: list[tuple[Change, str]] = [
    (no_data, "--activation"),
    (data(policy_kwargs=None), "--activation"),
    (data(policy_kwargs={"activation_fn": "<class '__main__.Swish'>"}), "--activation"),
    (data(policy_kwargs={"activation_fn": "functools.partial(<class 'torch.nn.LeakyReLU'>)"}), "--activation"),
    (data(policy_kwargs={"squash_output": "maybe"}), "--squash"),
    (data(policy_kwargs={"features_extractor_class": "<class '__main__.Mine'>"}), "features_extractor_class"),
    (data(policy_kwargs={"lstm_kwargs": {"bidirectional": True}}), "lstm_kwargs"),
    (data(policy_class={"__module__": "my_project.policies"}), "my_project"),
    (data(action_space=None), "--action-low"),
    (data(action_space={"low": "[-0.5 -0.4 -0.3 -0.9]"}), "--action-low"),
    (data(action_space={"low": "[-0.5]"}), "--action-low"),
    (data(action_space={":serialized:": "!"}), "--action-low"),
    (data(action_space={":type:": "<class 'gymnasium.spaces.discrete.Discrete'>"}), "only Box"),
    (data(observation_space={":type:": "<class 'gymnasium.spaces.dict.Dict'>"}), "only Box"),
    (data(observation_space={"_shape": [3, 64, 64], "dtype": "uint8"}), "image"),
    (data(observation_space={"_shape": [SIZE + 1]}), "observation_space"),
    (weights(not_finite), "action_net.bias holds NaN"),
    (weights(other_sizes), "do not fit"),
    (weights(extractor), "features_extractor"),
    (weights(lambda state: state.pop("lstm_actor.bias_hh_l0")), "lacks lstm_actor.bias_hh_l0"),
    (weights(lambda state: state.pop("action_net.bias")), "no action_net"),
    (weights(lambda state: state.update(log_std=torch.zeros(4, dtype=torch.int64))), "log_std"),
    (lambda entries: entries.update(data=b"[1]"), "JSON object"),
    (lambda entries: entries.update(data=b"{"), "not JSON"),
]


@pytest.mark.parametrize(("change", "word"), NAMED, ids=[word for _, word in NAMED])
def test_what_cannot_be_known_names_the_option(change: Change, word: str, folder: Path, tmp_path: Path) -> None:
    path = changed(folder, tmp_path / "model.zip", change)
    with pytest.raises(CheckpointError) as caught:
        load_any(path, folder / "layout.yaml")
    assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_archive_without_data_is_exported_by_options_alone(folder: Path, tmp_path: Path) -> None:
    path = changed(folder, tmp_path / "bare.zip", no_data)
    told = {"activation": "GELU", "squash": False, "action_low": LOW, "action_high": (1.0, 0.5, 0.6, 1.2)}
    for left_out, word in (("activation", "--activation"), ("squash", "--squash"), ("action_low", "--action-low")):
        with pytest.raises(CheckpointError, match=word):
            load_any(path, folder / "layout.yaml", Sb3Options(**(told | {left_out: None})))
    whole, bare = (
        load_any(folder / "model.zip", folder / "layout.yaml"),
        load_any(path, folder / "layout.yaml", Sb3Options(**told)),
    )
    observations, (h, c) = torch.randn(5, SIZE), whole.network.initial_state(5)
    for wanted, found in zip(whole.network.step(observations, h, c), bare.network.step(observations, h, c), strict=True):
        assert wanted is found or torch.equal(wanted, found)
    assert bare.layout.action.low == pytest.approx(whole.layout.action.low)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"activation": "swish9"}, "one of tanh"),
        ({"action_low": (-1.0,), "action_high": (1.0,)}, "4 values"),
        ({"action_low": (-9.0,) * 4, "action_high": (9.0,) * 4}, "leave them out"),
        ({"statistics": Path("absent.npz")}, "no such file"),
    ],
)
def test_options_that_cannot_be_right(options: dict[str, Any], word: str, folder: Path) -> None:
    with pytest.raises(CheckpointError, match=word):
        load_any(folder / "model.zip", folder / "layout.yaml", Sb3Options(**options))


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"mean": [0.0] * 5}, "hold 5 and 13"),
        ({"var": [-1.0] * SIZE}, "var >= 0"),
        ({"clip_obs": 0.0}, "clip_obs > 0"),
        ({"var": [0.0] * SIZE, "epsilon": 0.0}, "divided by 0"),
        ({"mean": ["x"] * SIZE}, "number lists"),
        ({"epsilon": None}, "finite"),
        ({"epsilon": "x"}, "numbers"),
    ],
)
def test_statistics_that_cannot_be_right(values: dict[str, Any], word: str, folder: Path, tmp_path: Path) -> None:
    good = {"mean": [0.0] * SIZE, "var": [1.0] * SIZE, "clip_obs": 10.0, "epsilon": 1e-8}
    path = tmp_path / "stats.json"
    path.write_text(json.dumps(good))
    assert load_any(folder / "model.zip", folder / "layout.yaml", Sb3Options(statistics=path)).network.observation_spread()
    path.write_text(json.dumps(good | values))
    with pytest.raises(CheckpointError, match=word):
        load_any(folder / "model.zip", folder / "layout.yaml", Sb3Options(statistics=path))


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("observation: [{name: velocty}]", "observation.0.name"),
        ("observation: [{name: velocity, frame: ned}]", "observation.0.frame"),
        ("observation: [{name: velocity, size: 4}]", "must hold 3 values"),
        ("observation: [{name: velocity, unit: m}]", "unit of velocity"),
        ("observation: [{name: other, unit: m}]", "needs a unit and a size"),
        ("observation: [{name: yaw}, {name: yaw}]", "appears twice"),
        (f"{LAYOUT}action: {{order: [vx, vx]}}", "twice"),
        (f"{LAYOUT}action: {{order: [vx, other]}}", "order must hold only"),
        (f"{LAYOUT}action: {{low: [1]}}", "low must hold 4"),
        (f"{LAYOUT}rate: 5", ":7: rate: unknown key"),
        (f"{LAYOUT}rate_hz: 0", ":7: rate_hz"),
    ],
)
def test_a_layout_with_a_mistake_names_line_and_field(text: str, word: str, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "layout.yaml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_any(folder / "model.zip", tmp_path / "layout.yaml")
    assert word in str(caught.value)


@pytest.mark.parametrize(
    ("layout", "word"),
    [
        (None, "the policy takes 13 values, the layout describes 190"),
        ("absent.yaml", "no such file"),
        (f"{LAYOUT}action: {{order: [vx, vy]}}", "action.order"),
        (f"{LAYOUT}action: {{low: [-9, -9, -9, -9]}}", "--rescale-action"),
        (f"{LAYOUT}action: {{frame: none}}", "frame must be heading or corridor"),
    ],
)
def test_a_layout_that_does_not_fit_the_policy(layout: str | None, word: str, folder: Path, tmp_path: Path) -> None:
    path: str | Path | None = layout
    if layout is not None and "\n" in layout:
        path = tmp_path / "layout.yaml"
        path.write_text(layout)
    with pytest.raises(CheckpointError) as caught:
        load_any(folder / "model.zip", path)
    assert word in str(caught.value)


def test_the_command_line_answers_mistakes_in_one_line(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.yaml").write_text("observation: 5\n")
    model, output = str(folder / "model.zip"), str(tmp_path / "policy.onnx")
    for extra, word in (
        (["--layout", str(tmp_path / "bad.yaml")], "bad.yaml:1: observation"),
        ([], "describes 190"),
        (["--action-low=a,b"], "separated by commas"),
        (["--action-low=nan,1,1,1"], "finite"),
    ):
        with pytest.raises(SystemExit) as caught:
            cli.main([model, "-o", output, *extra])
        assert caught.value.code == 2
        shown = capsys.readouterr().err
        assert len([line for line in shown.splitlines() if line.startswith("error:")]) == 1
        assert word in shown
    assert not Path(output).exists()
