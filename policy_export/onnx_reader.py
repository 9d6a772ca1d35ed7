"""A small, bounded reader of ONNX files: just enough to judge one before any runtime sees it. Needs neither onnx nor torch.

ONNX is a protobuf message (onnx/onnx.proto in the ONNX project gives the field numbers used here). The reader follows only the
fields that a policy file may have; a field that could smuggle in behaviour (external data, nested graphs, functions, sparse or
string tensors) or that it does not know is refused, not skipped. There is no recursion and every count is bounded.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from policy_export.contract import MAX_METADATA_BYTES
from policy_export.errors import PolicyFileError

MAX_NODES = 512
MAX_TENSORS = 512
_MAX_PROPERTIES = 64
_MAX_FIELDS = 4096
_MAX_NAME_BYTES = 256
_MAX_AXES = 8
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5

FLOAT, INT64 = 1, 7
"""ONNX TensorProto.DataType of the two types that a policy file may store."""
_TYPE_NAMES = {FLOAT: "float32", INT64: "int64"}

# Attribute fields of AttributeProto: name, f, i, s, floats, ints, strings, type, doc_string.
_PLAIN_ATTRIBUTE_FIELDS = {1, 2, 3, 4, 7, 8, 9, 13, 20}


@dataclass(frozen=True, slots=True)
class Tensor:
    """One initialiser: `data` are the raw little-endian bytes."""

    name: str
    elem_type: int
    dims: tuple[int, ...]
    data: memoryview

    def array(self) -> NDArray[np.float32] | NDArray[np.int64]:
        """The values as an array that shares the file's memory."""
        if self.elem_type == FLOAT:
            return np.frombuffer(self.data, dtype=np.dtype("<f4")).astype(np.float32, copy=False).reshape(self.dims)
        return np.frombuffer(self.data, dtype=np.dtype("<i8")).astype(np.int64, copy=False).reshape(self.dims)


@dataclass(frozen=True, slots=True)
class Port:
    """A graph input or output; a dimension is a number or a symbolic name."""

    name: str
    elem_type: int
    dims: tuple[int | str, ...]


@dataclass(frozen=True, slots=True)
class Model:
    """What a policy file holds. `spans` gives, for each metadata key, where its value's bytes lie in the file."""

    opset: int
    operators: tuple[str, ...]
    tensors: tuple[Tensor, ...]
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    metadata: dict[str, str]
    spans: dict[str, tuple[int, int]]


@dataclass(frozen=True, slots=True)
class _Field:
    number: int
    kind: int
    value: int  # of a varint or fixed field; 0 for bytes
    start: int
    stop: int


def read_model(data: bytes) -> Model:
    """Parse a whole file; raises `PolicyFileError` for anything that a policy file must not hold."""
    view = memoryview(data)
    opsets: list[int] = []
    graphs: list[_Field] = []
    metadata: dict[str, str] = {}
    spans: dict[str, tuple[int, int]] = {}
    for field in _fields(view, 0, len(view), "file"):
        if field.number == 7:
            graphs.append(_message(field, "graph"))
        elif field.number == 8:
            opsets.append(_opset(view, _message(field, "opset_import")))
        elif field.number == 14:
            key, text, span = _property(view, _message(field, "metadata_props"))
            if key in metadata or len(metadata) >= _MAX_PROPERTIES:
                raise PolicyFileError("metadata_props", f"key {key!r} appears twice or there are too many keys")
            metadata[key], spans[key] = text, span
        elif field.number not in {1, 2, 3, 4, 5, 6}:  # versions, producer, domain, doc_string
            raise PolicyFileError("file", f"holds ONNX model field {field.number} (such as functions), which is not allowed")
    if len(graphs) != 1 or len(opsets) != 1:
        raise PolicyFileError("file", "is not an ONNX model with one graph and one operator set")
    operators, tensors, inputs, outputs = _graph(view, graphs[0])
    return Model(opsets[0], operators, tensors, inputs, outputs, metadata, spans)


def weights_sha256(tensors: tuple[Tensor, ...]) -> str:
    """SHA-256 over all initialisers, sorted by the UTF-8 bytes of their names.

    Per tensor: name, a zero byte, type name, a zero byte, dimensions in decimal joined by `x`, a zero byte, the raw
    little-endian values in row-major order.
    """
    digest = hashlib.sha256()
    for tensor in sorted(tensors, key=lambda tensor: tensor.name.encode()):
        shape = "x".join(str(size) for size in tensor.dims)
        digest.update(f"{tensor.name}\0{_TYPE_NAMES[tensor.elem_type]}\0{shape}\0".encode())
        digest.update(tensor.data)
    return digest.hexdigest()


def file_sha256(data: bytes, span: tuple[int, int]) -> str:
    """SHA-256 over the whole file with the bytes of `span` (the digest's own place) replaced by ASCII zeros."""
    digest = hashlib.sha256(data[: span[0]])
    digest.update(b"0" * (span[1] - span[0]))
    digest.update(data[span[1] :])
    return digest.hexdigest()


def _varint(view: memoryview, position: int, stop: int, where: str) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if position >= stop:
            raise PolicyFileError(where, "cut off in the middle of a number")
        byte = view[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, position
    raise PolicyFileError(where, "holds a number of more than 10 bytes")


def _fields(view: memoryview, start: int, stop: int, where: str) -> Iterator[_Field]:
    """The fields of one protobuf message in `start:stop`."""
    position, count = start, 0
    while position < stop:
        count += 1
        if count > _MAX_FIELDS:
            raise PolicyFileError(where, f"has more than {_MAX_FIELDS} fields")
        tag, position = _varint(view, position, stop, where)
        number, kind, value = tag >> 3, tag & 7, 0
        begin = position
        if kind == _VARINT:
            value, position = _varint(view, position, stop, where)
        elif kind == _BYTES:
            size, begin = _varint(view, position, stop, where)
            position = begin + size
        elif kind in {_FIXED64, _FIXED32}:
            position += 8 if kind == _FIXED64 else 4
        else:
            raise PolicyFileError(where, "is not valid protobuf")
        if position > stop or number == 0:
            raise PolicyFileError(where, "is cut off or not valid protobuf")
        yield _Field(number, kind, value, begin, position)


def _message(field: _Field, where: str) -> _Field:
    if field.kind != _BYTES:
        raise PolicyFileError(where, "is not valid protobuf")
    return field


def _text(view: memoryview, field: _Field, where: str, limit: int = _MAX_NAME_BYTES) -> str:
    _message(field, where)
    if field.stop - field.start > limit:
        raise PolicyFileError(where, f"is longer than {limit} bytes")
    try:
        return str(view[field.start : field.stop], "utf-8")
    except UnicodeDecodeError:
        raise PolicyFileError(where, "is not UTF-8 text") from None


def _opset(view: memoryview, message: _Field) -> int:
    version = 0
    for field in _fields(view, message.start, message.stop, "opset_import"):
        if field.number == 1 and _text(view, field, "opset_import.domain") not in {"", "ai.onnx"}:
            raise PolicyFileError("opset_import.domain", "custom operator sets are not allowed")
        if field.number == 2:
            version = field.value
    return version


def _property(view: memoryview, message: _Field) -> tuple[str, str, tuple[int, int]]:
    key, text, span = "", "", (0, 0)
    for field in _fields(view, message.start, message.stop, "metadata_props"):
        if field.number == 1:
            key = _text(view, field, "metadata_props.key")
        elif field.number == 2:
            text, span = _text(view, field, "metadata_props.value", MAX_METADATA_BYTES), (field.start, field.stop)
    return key, text, span


def _graph(view: memoryview, message: _Field) -> tuple[tuple[str, ...], tuple[Tensor, ...], tuple[Port, ...], tuple[Port, ...]]:
    operators: list[str] = []
    tensors: list[Tensor] = []
    inputs: list[Port] = []
    outputs: list[Port] = []
    for field in _fields(view, message.start, message.stop, "graph"):
        if field.number == 1:
            operators.append(_node(view, _message(field, "graph.node")))
        elif field.number == 5:
            tensors.append(_tensor(view, _message(field, "graph.initializer")))
        elif field.number == 11:
            inputs.append(_port(view, _message(field, "graph.input")))
        elif field.number == 12:
            outputs.append(_port(view, _message(field, "graph.output")))
        elif field.number not in {2, 10, 13}:  # name, doc_string, value_info
            raise PolicyFileError("graph", f"holds ONNX graph field {field.number}, which is not allowed")
        if len(operators) > MAX_NODES or len(tensors) > MAX_TENSORS:
            raise PolicyFileError("graph", f"has more than {MAX_NODES} operators or {MAX_TENSORS} initialisers")
    if len({tensor.name for tensor in tensors}) != len(tensors):
        raise PolicyFileError("graph.initializer", "a name appears twice")
    return tuple(operators), tuple(tensors), tuple(inputs), tuple(outputs)


def _node(view: memoryview, message: _Field) -> str:
    operator = ""
    for field in _fields(view, message.start, message.stop, "graph.node"):
        if field.number == 4:
            operator = _text(view, field, "graph.node.op_type")
        elif field.number == 5:
            _plain_attribute(view, _message(field, "graph.node.attribute"))
        elif field.number == 7 and _text(view, field, "graph.node.domain") not in {"", "ai.onnx"}:
            raise PolicyFileError("graph.node.domain", "custom operators are not allowed")
        elif field.number not in {1, 2, 3, 6, 7}:  # inputs, outputs, name, doc_string, domain
            raise PolicyFileError("graph.node", f"holds ONNX node field {field.number}, which is not allowed")
    return operator


def _plain_attribute(view: memoryview, message: _Field) -> None:
    for field in _fields(view, message.start, message.stop, "graph.node.attribute"):
        if field.number not in _PLAIN_ATTRIBUTE_FIELDS:
            problem = "nested graphs (control flow) and tensors inside operators are not allowed"
            raise PolicyFileError("graph.node.attribute", problem)


def _tensor(view: memoryview, message: _Field) -> Tensor:
    name, elem_type, dims, data = "", 0, [], view[0:0]
    for field in _fields(view, message.start, message.stop, "graph.initializer"):
        if field.number == 1:
            dims.extend(_dimensions(view, field))
        elif field.number == 2:
            elem_type = field.value
        elif field.number == 8:
            name = _text(view, field, "graph.initializer.name")
        elif field.number == 9:
            data = view[_message(field, "graph.initializer").start : field.stop]
        elif field.number in {13, 14}:
            if field.number == 13 or field.value != 0:
                raise PolicyFileError(f"weights.{name}", "external data is not allowed; the file must hold its own weights")
        elif field.number != 12:  # doc_string
            raise PolicyFileError(f"weights.{name}", "is not stored as raw data")
    return _checked_tensor(Tensor(name, elem_type, tuple(dims), data))


def _dimensions(view: memoryview, field: _Field) -> list[int]:
    if field.kind == _VARINT:
        return [field.value]
    sizes, position = [], field.start
    while position < field.stop:
        size, position = _varint(view, position, field.stop, "graph.initializer.dims")
        sizes.append(size)
        if len(sizes) > _MAX_AXES:
            raise PolicyFileError("graph.initializer.dims", f"has more than {_MAX_AXES} axes")
    return sizes


def _checked_tensor(tensor: Tensor) -> Tensor:
    width = {FLOAT: 4, INT64: 8}.get(tensor.elem_type)
    if width is None:
        raise PolicyFileError(f"weights.{tensor.name}", f"has ONNX type {tensor.elem_type}; only float32 and int64 are allowed")
    count = 1
    for size in tensor.dims[:_MAX_AXES]:
        count *= size
    if len(tensor.dims) > _MAX_AXES or count * width != len(tensor.data):
        raise PolicyFileError(f"weights.{tensor.name}", f"shape {tensor.dims} does not fit its {len(tensor.data)} bytes")
    return tensor


def _port(view: memoryview, message: _Field) -> Port:
    """ValueInfoProto{name 1, type 2: TypeProto{tensor_type 1: {elem_type 1, shape 2: {dim 1: {value 1, param 2}}}}}."""
    name, elem_type, dims = "", 0, []
    for field in _fields(view, message.start, message.stop, "graph.port"):
        if field.number == 1:
            name = _text(view, field, "graph.port.name")
        elif field.number == 2:
            for tensor_type in _only(view, field, 1):
                for part in _fields(view, tensor_type.start, tensor_type.stop, "graph.port.type"):
                    if part.number == 1:
                        elem_type = part.value
                    elif part.number == 2:
                        dims = [_dimension(view, dim) for dim in _only(view, part, 1)]
    return Port(name, elem_type, tuple(dims))


def _only(view: memoryview, message: _Field, number: int) -> list[_Field]:
    _message(message, "graph.port.type")
    fields = list(_fields(view, message.start, message.stop, "graph.port.type"))
    if any(field.number != number or field.kind != _BYTES for field in fields):
        raise PolicyFileError("graph.port.type", "inputs and outputs must be plain tensors")
    return fields


def _dimension(view: memoryview, message: _Field) -> int | str:
    for field in _fields(view, message.start, message.stop, "graph.port.shape"):
        if field.number == 1:
            return field.value
        if field.number == 2:
            return _text(view, field, "graph.port.shape")
    return "?"
