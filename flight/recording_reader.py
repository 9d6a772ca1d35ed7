"""Reads a recording, whole or cut off: every record that is still there, and the flight that they make up.

MCAP is a row of records (opcode, length, content; https://mcap.dev/spec). The framing is read here, because the usual
readers refuse a file without its end; what a record means is left to the `mcap` package (extra `record`).
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import IO, Any

from pydantic import ValidationError

from flight.recording_schema import (
    EVENT_TOPIC,
    HEADER_TOPIC,
    POLICY_ATTACHMENT,
    SCAN_TOPIC,
    TICK_TOPIC,
    FlightHeader,
    RecordingError,
    TickSample,
    decode_event,
    decode_scan,
    decode_tick,
)
from safety.messages import LidarScan

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 64 * 1024 * 1024
MAX_TICKS = 1_000_000
"""14 hours at 20 Hz."""
_FRAME = struct.Struct("<BQ")
_NOT_INSTALLED = "reading recordings needs the mcap package: pip install 'lstm-pilot[record]'"


@dataclass(slots=True)
class Salvage:
    """What came of reading a file record by record. `damaged`: chunks (or single records) left out. `cut`: why reading ended
    before the file's own end, None for a whole file.
    """

    bytes_read: int = 0
    damaged: int = 0
    cut: str | None = None


def salvaged_records(file: IO[bytes], salvage: Salvage) -> Iterator[Any]:
    """Schemas, channels, messages, attachments and metadata of a file in its order, up to its end or the first unreadable record.

    A chunk whose checksum is wrong is left out and counted. Raises `RecordingError` where this is no MCAP file at all.
    """
    records = mcap_records()
    if file.read(len(MAGIC)) != MAGIC:
        raise RecordingError("not an MCAP file (its first eight bytes say so)")
    salvage.bytes_read = len(MAGIC)
    while True:
        framed = _read_framed(file, salvage)
        if framed is None:
            return
        opcode, content = framed
        if opcode == records.Opcode.DATA_END:
            salvage.cut = None if _has_end(file) else "the file's index is missing"
            return
        if opcode == records.Opcode.CHUNK:
            yield from _intact(_unpacked(content), salvage)
        else:
            yield from _intact(_decoded(opcode, content), salvage)


def _read_framed(file: IO[bytes], salvage: Salvage) -> tuple[int, bytes] | None:
    """The next record's opcode and content; None, with the reason in `salvage.cut`, when there is no whole one."""
    frame = file.read(_FRAME.size)
    if len(frame) < _FRAME.size:
        salvage.cut = "the file ends between two records" if not frame else "the file ends within a record"
        return None
    opcode, length = _FRAME.unpack(frame)
    if opcode == 0 or length > MAX_RECORD_BYTES:
        salvage.cut = "the last record was never finished"
        return None
    content = file.read(length)
    if len(content) < length:
        salvage.cut = "the file ends within a record"
        return None
    salvage.bytes_read += _FRAME.size + length
    return opcode, content


def _has_end(file: IO[bytes]) -> bool:
    """Whether the closing magic is there."""
    try:
        file.seek(-len(MAGIC), io.SEEK_END)
    except OSError:
        return False
    return file.read() == MAGIC


def _intact(found: Iterator[Any], salvage: Salvage) -> list[Any]:
    """All the records of a chunk, or none of them where it is damaged."""
    try:
        return list(found)
    except (ValueError, struct.error, EOFError, IndexError, KeyError, MemoryError, mcap_records().McapError):
        salvage.damaged += 1
        return []


def _unpacked(content: bytes) -> Iterator[Any]:
    """The records in a chunk. Raises what `_intact` catches."""
    records = mcap_records()
    chunk = records.Chunk.read(records.ReadDataStream(io.BytesIO(content)))
    data = _decompressed(chunk)
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("wrong checksum")
    position = 0
    while position < len(data):
        opcode, length = _FRAME.unpack_from(data, position)
        position += _FRAME.size
        if length > len(data) - position:
            raise ValueError("a record is longer than its chunk")
        yield from _decoded(opcode, data[position : position + length])
        position += length


def _decompressed(chunk: Any) -> bytes:
    if chunk.uncompressed_size > MAX_RECORD_BYTES:
        raise ValueError("chunk too large")
    if not chunk.compression:
        return bytes(chunk.data)
    if chunk.compression != "zstd":
        raise ValueError(f"compression {chunk.compression} is not used by fly")
    import zstandard  # noqa: PLC0415  (comes with mcap)

    try:
        if zstandard.frame_content_size(chunk.data) > MAX_RECORD_BYTES:  # -1: not stated
            raise ValueError("chunk too large")
        return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=chunk.uncompressed_size)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from None


def _decoded(opcode: int, content: bytes) -> Iterator[Any]:
    """A record as an object of `mcap.records`, if it is of a kind that carries something. Raises what `_intact` catches."""
    records = mcap_records()
    stream = records.ReadDataStream(io.BytesIO(content))
    kind = records.kinds.get(opcode)
    if opcode == records.Opcode.MESSAGE:
        yield records.Message.read(stream, len(content))
    elif kind is not None:
        yield kind.read(stream)


class _Mcap:
    """The parts of the mcap package that are used, imported when the first recording is read."""

    def __init__(self) -> None:
        try:
            from mcap.data_stream import ReadDataStream  # noqa: PLC0415
            from mcap.exceptions import McapError  # noqa: PLC0415
            from mcap.opcode import Opcode  # noqa: PLC0415
            from mcap.records import Attachment, Channel, Chunk, Header, Message, Metadata, Schema  # noqa: PLC0415
        except ImportError:
            raise RecordingError(_NOT_INSTALLED) from None
        self.McapError = McapError
        self.ReadDataStream, self.Opcode, self.Message, self.Chunk = ReadDataStream, Opcode, Message, Chunk
        self.Schema, self.Channel, self.Attachment, self.Metadata = Schema, Channel, Attachment, Metadata
        self.kinds: dict[int, Any] = {
            Opcode.HEADER: Header,
            Opcode.SCHEMA: Schema,
            Opcode.CHANNEL: Channel,
            Opcode.ATTACHMENT: Attachment,
            Opcode.METADATA: Metadata,
        }


@cache
def mcap_records() -> _Mcap:
    """The record classes of the mcap package. Raises `RecordingError` where it is not installed."""
    return _Mcap()


# -- the flight in a recording ----------------------------------------------------------------------------------


@dataclass(slots=True)
class Recording:
    """A recorded flight: header, policy file and ticks in order, each with the very scan object that it saw.

    `events`: (Unix time in ns, text). `salvage`: whether the file was whole.
    """

    header: FlightHeader
    policy: bytes | None
    ticks: list[TickSample] = field(default_factory=list)
    events: list[tuple[int, str]] = field(default_factory=list)
    salvage: Salvage = field(default_factory=Salvage)

    @property
    def missing_ticks(self) -> int:
        """Ticks that were flown but are not in the recording (before its end)."""
        return self.ticks[-1].tick + 1 - len(self.ticks) if self.ticks else 0


def read_recording(path: Path) -> Recording:
    """Read a whole or cut recording of `fly`. Raises `RecordingError`."""
    builder = _Builder()
    salvage = Salvage()
    try:
        with path.open("rb") as file:
            for record in salvaged_records(file, salvage):
                builder.take(record)
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror}") from None
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None
    if builder.header is None and salvage.cut is not None:
        raise RecordingError(f"{path}: nothing of a flight can be read from it: {salvage.cut}, before its first whole chunk")
    if builder.header is None:
        raise RecordingError(f"{path} is not a recording of fly: it has no message on {HEADER_TOPIC}")
    return Recording(builder.header, builder.policy, builder.ticks, builder.events, salvage)


class _Builder:
    """Puts a flight together from its records."""

    def __init__(self) -> None:
        self.header: FlightHeader | None = None
        self.policy: bytes | None = None
        self.ticks: list[TickSample] = []
        self.events: list[tuple[int, str]] = []
        self._topics: dict[int, str] = {}
        self._scan: tuple[int, LidarScan] | None = None

    def take(self, record: Any) -> None:
        """The next record of the file."""
        kinds = mcap_records()
        if isinstance(record, kinds.Channel):
            self._topics[record.id] = record.topic
        elif isinstance(record, kinds.Attachment) and record.name == POLICY_ATTACHMENT:
            self.policy = bytes(record.data)
        elif isinstance(record, kinds.Message):
            self._message(self._topics.get(record.channel_id), record)

    def _message(self, topic: str | None, message: Any) -> None:
        if topic == HEADER_TOPIC:
            self.header = _header(bytes(message.data))
        elif topic == SCAN_TOPIC:
            self._scan = decode_scan(message.data)
        elif topic == TICK_TOPIC:
            self._tick(message.data)
        elif topic == EVENT_TOPIC:
            self.events.append((message.log_time, decode_event(message.data)))

    def _tick(self, data: bytes) -> None:
        if len(self.ticks) >= MAX_TICKS:
            raise RecordingError(f"it holds more than {MAX_TICKS} ticks; no flight does")
        sample, number = decode_tick(data)
        if number is None:
            self.ticks.append(sample)
        elif self._scan is not None and self._scan[0] == number:
            self.ticks.append(with_scan(sample, self._scan[1]))
        # else: its scan was in a damaged chunk; the tick counts as missing


def with_scan(sample: TickSample, scan: LidarScan) -> TickSample:
    """The same tick with the scan it saw."""
    return replace(sample, scan=scan)


def _header(data: bytes) -> FlightHeader:
    try:
        return FlightHeader.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        raise RecordingError(f"its header cannot be read by this version of fly: {name}: {first['msg']}") from None
