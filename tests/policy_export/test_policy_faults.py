"""Damaged and hostile policy files: every one is refused, with the field's name, before onnxruntime sees it."""

from __future__ import annotations

import contextlib
import os
import resource
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper
from policy_samples import Damage, damaged, seal

from policy_export import runner
from policy_export.contract import DIGEST_KEY, METADATA_KEY
from policy_export.errors import PolicyFileError
from policy_export.onnx_reader import read_model, weights_sha256
from policy_export.policy_file import MAX_FILE_BYTES, check_policy_bytes, read_policy_file
from policy_export.runner import PolicyRunner


@settings(max_examples=150, deadline=None)
@given(place=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(1, 255))
def test_no_changed_byte_goes_unnoticed(policy_bytes: bytes, place: float, flip: int) -> None:
    changed = bytearray(policy_bytes)
    changed[int(place * len(changed))] ^= flip
    with pytest.raises(PolicyFileError):
        check_policy_bytes(bytes(changed))


@settings(max_examples=150, deadline=None)
@given(from_end=st.integers(1, 6000), flip=st.integers(1, 255))
def test_no_changed_byte_near_the_metadata_goes_unnoticed(policy_bytes: bytes, from_end: int, flip: int) -> None:
    changed = bytearray(policy_bytes)
    changed[-from_end] ^= flip
    with pytest.raises(PolicyFileError):
        check_policy_bytes(bytes(changed))


@settings(max_examples=60, deadline=None)
@given(keep=st.floats(0.0, 1.0, exclude_max=True))
def test_truncated_files_are_refused(policy_bytes: bytes, keep: float) -> None:
    with pytest.raises(PolicyFileError):
        check_policy_bytes(policy_bytes[: int(keep * len(policy_bytes))])


@settings(max_examples=200, deadline=None)
@given(junk=st.binary(max_size=2000))
def test_junk_is_refused_in_one_line(junk: bytes) -> None:
    with pytest.raises(PolicyFileError) as caught:
        check_policy_bytes(junk)
    assert "\n" not in str(caught.value)


def rename_input(model: onnx.ModelProto) -> None:
    model.graph.input[0].name = "observation"


def drop_state_input(model: onnx.ModelProto) -> None:
    del model.graph.input[1]


def extra_output(model: onnx.ModelProto) -> None:
    model.graph.output.append(helper.make_tensor_value_info("debug", TensorProto.FLOAT, ["batch"]))


def wrong_rank(model: onnx.ModelProto) -> None:
    del model.graph.input[1].type.tensor_type.shape.dim[0]


def wrong_type(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.elem_type = TensorProto.DOUBLE


def wrong_width(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[1].dim_value = 189


def fixed_batch(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 1


def no_metadata(model: onnx.ModelProto) -> None:
    kept = [entry for entry in model.metadata_props if entry.key != METADATA_KEY]
    del model.metadata_props[:]
    model.metadata_props.extend(kept)


def metadata_twice(model: onnx.ModelProto) -> None:
    model.metadata_props.add(key=METADATA_KEY, value="{}")


def faster_limits(model: onnx.ModelProto) -> None:
    for entry in model.metadata_props:
        entry.value = entry.value.replace('"schema_version":1', '"schema_version":9')


def not_a_number(model: onnx.ModelProto, value: float = np.nan) -> None:
    tensor = model.graph.initializer[-3]
    values = numpy_helper.to_array(tensor).copy()
    values.flat[0] = value
    tensor.CopyFrom(numpy_helper.from_array(values, tensor.name))


def infinite(model: onnx.ModelProto) -> None:
    not_a_number(model, np.inf)


def other_weights(model: onnx.ModelProto) -> None:
    not_a_number(model, 0.5)


def external_data(model: onnx.ModelProto) -> None:
    tensor = model.graph.initializer[-3]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../../etc/passwd")


def packed_floats(model: onnx.ModelProto) -> None:
    tensor = model.graph.initializer[-3]
    values = numpy_helper.to_array(tensor).ravel().tolist()
    tensor.ClearField("raw_data")
    tensor.float_data.extend(values)


def half_a_tensor(model: onnx.ModelProto) -> None:
    tensor = model.graph.initializer[-3]
    tensor.raw_data = tensor.raw_data[:-4]


def double_weights(model: onnx.ModelProto) -> None:
    tensor = model.graph.initializer[-3]
    tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor).astype(np.float64), tensor.name))


def custom_operator(model: onnx.ModelProto) -> None:
    model.graph.node[0].domain = "com.example"


def custom_opset(model: onnx.ModelProto) -> None:
    model.opset_import.append(helper.make_opsetid("com.example", 1))


def old_opset(model: onnx.ModelProto) -> None:
    model.opset_import[0].version = 7


def operator_outside_the_list(model: onnx.ModelProto) -> None:
    model.graph.node[0].op_type = "RandomNormalLike"


def endless_loop(model: onnx.ModelProto) -> None:
    state = [helper.make_tensor_value_info(name, TensorProto.BOOL, []) for name in ("go", "go_on")]
    count = helper.make_tensor_value_info("count", TensorProto.INT64, [])
    body = helper.make_graph([helper.make_node("Identity", ["go"], ["go_on"])], "body", [count, state[0]], [state[1]])
    model.graph.node.append(helper.make_node("Loop", ["", "yes"], [], body=body))


def function(model: onnx.ModelProto) -> None:
    node = helper.make_node("Identity", ["x"], ["y"])
    model.functions.append(helper.make_function("", "f", ["x"], ["y"], [node], [helper.make_opsetid("", 18)]))


def sparse_weights(model: onnx.ModelProto) -> None:
    values = numpy_helper.from_array(np.ones(1, dtype=np.float32), "sparse")
    model.graph.sparse_initializer.append(helper.make_sparse_tensor(values, numpy_helper.from_array(np.array([0])), [4]))


def constant_tensor(model: onnx.ModelProto) -> None:
    value = numpy_helper.from_array(np.ones(1, dtype=np.float32))
    model.graph.node.append(helper.make_node("Constant", [], ["k"], value=value))


def too_many_nodes(model: onnx.ModelProto) -> None:
    model.graph.node.extend([helper.make_node("Identity", ["obs"], [f"copy{k}"]) for k in range(600)])


def same_name_twice(model: onnx.ModelProto) -> None:
    model.graph.initializer.append(model.graph.initializer[0])


DAMAGES: list[tuple[Damage, str]] = [
    (rename_input, "input"),
    (drop_state_input, "input"),
    (extra_output, "output"),
    (wrong_rank, "input.h_in"),
    (wrong_type, "input.obs"),
    (wrong_width, "input.obs"),
    (fixed_batch, "input.obs"),
    (no_metadata, "metadata"),
    (metadata_twice, "metadata_props"),
    (faster_limits, "metadata.schema_version"),
    (not_a_number, "weights."),
    (infinite, "weights."),
    (other_weights, "metadata.weights_sha256"),
    (external_data, "weights."),
    (packed_floats, "weights."),
    (half_a_tensor, "weights."),
    (double_weights, "weights."),
    (custom_operator, "graph.node.domain"),
    (custom_opset, "opset_import.domain"),
    (old_opset, "opset_import"),
    (operator_outside_the_list, "graph.node"),
    (endless_loop, "graph.node.attribute"),
    (function, "file"),
    (sparse_weights, "graph"),
    (constant_tensor, "graph.node.attribute"),
    (too_many_nodes, "graph"),
    (same_name_twice, "graph.initializer"),
]


@pytest.mark.parametrize(("damage", "field"), DAMAGES, ids=lambda value: getattr(value, "__name__", None))
def test_a_fault_is_refused_by_name_even_under_a_fitting_digest(
    policy_bytes: bytes, damage: Damage, field: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = damaged(policy_bytes, damage, sealed=False)
    # Where the reader already refuses the structure there is nothing to seal; the check below says whether for the right reason.
    with contextlib.suppress(PolicyFileError):
        data = seal(data)
    with pytest.raises(PolicyFileError) as caught:
        check_policy_bytes(data)
    assert caught.value.field.startswith(field), caught.value
    assert "\n" not in str(caught.value)
    # What `fly` calls before it starts anything, with the same answer, and without onnxruntime having seen the file.
    path = tmp_path / "policy.onnx"
    path.write_bytes(data)
    monkeypatch.setattr(runner.ort, "InferenceSession", None)
    with pytest.raises(PolicyFileError) as again:
        PolicyRunner.load(path)
    assert str(again.value) == str(caught.value)


def test_the_undamaged_file_passes_the_same_way(policy_bytes: bytes) -> None:
    assert check_policy_bytes(damaged(policy_bytes, lambda model: None)).metadata.name == "test"


def test_a_missing_digest_is_refused(policy_bytes: bytes) -> None:
    def drop(model: onnx.ModelProto) -> None:
        del model.metadata_props[1]

    with pytest.raises(PolicyFileError) as caught:
        check_policy_bytes(damaged(policy_bytes, drop, sealed=False))
    assert caught.value.field == DIGEST_KEY


def test_a_graph_that_onnxruntime_cannot_run_is_refused_quietly(
    policy_bytes: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def swap(model: onnx.ModelProto) -> None:
        model.graph.node[-2].input[0] = "nowhere"

    path = tmp_path / "broken.onnx"
    path.write_bytes(damaged(policy_bytes, swap))
    with pytest.raises(PolicyFileError, match="graph: onnxruntime refuses it"):
        PolicyRunner.load(path)
    assert capfd.readouterr() == ("", "")


def test_a_graph_that_leaves_its_own_limits_is_refused_on_load(policy_bytes: bytes, tmp_path: Path) -> None:
    def unscaled(model: onnx.ModelProto) -> None:
        half = next(tensor for tensor in model.graph.initializer if tensor.name == "action_middle")
        half.CopyFrom(numpy_helper.from_array(np.full(4, 9.0, dtype=np.float32), half.name))
        fresh = weights_sha256(read_model(model.SerializeToString()).tensors)
        stated = weights_sha256(read_model(policy_bytes).tensors)
        model.metadata_props[0].value = model.metadata_props[0].value.replace(stated, fresh)

    path = tmp_path / "wild.onnx"
    path.write_bytes(damaged(policy_bytes, unscaled))
    with pytest.raises(PolicyFileError, match="outside its own limits"):
        PolicyRunner.load(path)


def test_files_that_are_no_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path, word in (
        (tmp_path / "absent.onnx", "cannot read"),
        (tmp_path, "regular file"),
        (tmp_path / "pipe", "regular file"),
    ):
        with pytest.raises(PolicyFileError, match=word):
            read_policy_file(path)


def test_a_file_of_2_gb_is_refused_without_reading_it(tmp_path: Path) -> None:
    path = tmp_path / "huge.onnx"
    with path.open("wb") as stream:
        stream.truncate(2 * 1024**3)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(PolicyFileError, match="more than"):
        read_policy_file(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MAX_FILE_BYTES / 1024


def test_weights_digest_is_the_documented_one(policy_bytes: bytes) -> None:
    """Written again from docs/policy_file.md with the onnx package, as another program would."""
    import hashlib

    digest = hashlib.sha256()
    for tensor in sorted(onnx.load_from_string(policy_bytes).graph.initializer, key=lambda tensor: tensor.name.encode()):
        array = numpy_helper.to_array(tensor)
        digest.update(tensor.name.encode() + b"\0" + str(array.dtype).encode() + b"\0")
        digest.update("x".join(map(str, array.shape)).encode() + b"\0" + array.tobytes())
    assert digest.hexdigest() == check_policy_bytes(policy_bytes).metadata.weights_sha256
