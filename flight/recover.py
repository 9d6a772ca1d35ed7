"""`fly recover FILE`: an indexed MCAP file from one that a power cut or a SIGKILL left without its end.

The original is never changed. Everything up to the last finished chunk is kept, message by message and byte for byte, with
attachments; what was under way when the power went (at most the last second) is lost.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from flight.recording_reader import Salvage, mcap_records, salvaged_records
from flight.recording_schema import RecordingError


@dataclass(slots=True)
class Recovery:
    """What was saved. `output`: None where the file was whole. `first_ns`, `last_ns`: Unix times of its messages."""

    output: Path | None
    size_bytes: int
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    salvage: Salvage = field(default_factory=Salvage)

    @property
    def duration_s(self) -> float:
        """From the first message to the last."""
        return max(0.0, (self.last_ns - self.first_ns) * 1e-9)

    @property
    def lost_bytes(self) -> int:
        """Bytes at the end of a cut file that could not be read."""
        return self.size_bytes - self.salvage.bytes_read if self.salvage.cut is not None else 0

    def as_dict(self) -> dict[str, object]:
        """For --json."""
        return {
            "output": str(self.output) if self.output is not None else None,
            "messages": self.messages,
            "duration_s": self.duration_s,
            "lost_bytes": self.lost_bytes,
            "damaged": self.salvage.damaged,
            "cut": self.salvage.cut,
        }

    def describe(self) -> str:
        """One line for the user."""
        saved = f"{self.messages} messages, {self.duration_s:.1f} s"
        if self.output is None:
            return f"nothing to recover: the file is whole ({saved})"
        damaged = f", {self.salvage.damaged} damaged part(s) left out" if self.salvage.damaged else ""
        return f"{self.output}: {saved}; {self.salvage.cut or 'damaged'}, {self.lost_bytes} bytes lost{damaged}"


def recover(path: Path, output: Path | None = None) -> Recovery:
    """Write the readable part of `path` to `output` (default: its name with `-recovered`). Raises `RecordingError`.

    A whole file is only checked. An existing output is never replaced.
    """
    target = output if output is not None else path.with_name(f"{path.stem}-recovered{path.suffix}")
    try:
        result = _inspect(path)
        if result.salvage.cut is None and not result.salvage.damaged:
            return result
        if result.messages == 0:
            raise RecordingError(f"{path}: no message in it can be read; there is nothing to recover")
        if target.exists():
            raise RecordingError(f"{target} exists already: give another name with --out")
        _write(path, target)
    except OSError as error:
        elsewhere = "" if str(error.filename) == str(path) else f"{error.filename or target}: "
        raise RecordingError(f"cannot recover {path}: {elsewhere}{error.strerror}") from None
    result.output = target
    return result


def _inspect(path: Path) -> Recovery:
    """Read the file once, counting."""
    result = Recovery(None, path.stat().st_size)
    with path.open("rb") as file:
        for record in _named(path, file, result.salvage):
            if isinstance(record, mcap_records().Message):
                result.messages += 1
                result.first_ns = min(result.first_ns or record.log_time, record.log_time)
                result.last_ns = max(result.last_ns, record.log_time)
    return result


def _named(path: Path, file: IO[bytes], salvage: Salvage) -> Iterator[Any]:
    try:
        yield from salvaged_records(file, salvage)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None


def _write(path: Path, target: Path) -> None:
    """Copy what can be read into a new file beside `target`, which appears whole or not at all."""
    descriptor, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
    try:
        with os.fdopen(descriptor, "wb") as sink, path.open("rb") as source:
            _copy(salvaged_records(source, Salvage()), sink)
            sink.flush()
            os.fsync(sink.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(target)
    finally:
        Path(temporary).unlink(missing_ok=True)


def _copy(records: Iterator[Any], sink: IO[bytes]) -> None:
    """Write records with an index. A message whose channel was lost with a damaged chunk is left out."""
    from mcap.writer import Writer  # noqa: PLC0415  (optional: extra `record`)

    kinds = mcap_records()
    writer = Writer(sink, chunk_size=1024 * 1024)
    writer.start(profile="lstm_pilot", library="fly recover")
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    for record in records:
        if isinstance(record, kinds.Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, kinds.Channel) and record.id not in channels and record.schema_id in schemas:
            channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
            )
        elif isinstance(record, kinds.Message) and record.channel_id in channels:
            writer.add_message(channels[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence)
        elif isinstance(record, kinds.Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, kinds.Metadata):
            writer.add_metadata(record.name, record.metadata)
    writer.finish()  # type: ignore[no-untyped-call]
