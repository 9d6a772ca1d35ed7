"""ULog, PX4's log format, as far as the gateway writes it: header, flags, information, formats, subscriptions, data, texts.

A file is 16 bytes of header and then messages: u16 size of the body, u8 type, body; little-endian. Only what PX4's description
of the file format asks of a writer; times are microseconds of vehicle time.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

MAGIC = b"ULog\x01\x12\x35"
_VERSION = 1
_FLAG_BYTES = 8 + 8 + 3 * 8  # compatible and incompatible flags, offsets of appended data: none of them is used
_STRUCT = {"uint64_t": "Q", "uint32_t": "I", "uint8_t": "B", "bool": "?", "float": "f"}


@dataclass(frozen=True, slots=True)
class Topic:
    """A kind of sample. `fields`: (type, name) after the timestamp, largest types first, so that nothing is padded."""

    name: str
    fields: tuple[tuple[str, str], ...]

    @property
    def definition(self) -> str:
        """As a format message has it."""
        return f"{self.name}:uint64_t timestamp;" + "".join(f"{kind} {name};" for kind, name in self.fields)

    def pack(self, time_us: int, *values: float) -> bytes:
        """One sample."""
        return struct.pack("<Q" + "".join(_STRUCT[kind] for kind, _ in self.fields), time_us, *values)


def _message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def head(start_us: int, facts: dict[str, str], topics: tuple[Topic, ...]) -> bytes:
    """A file up to its first sample. `facts`: information messages. Topics are numbered in their order, from 0."""
    parts = [MAGIC + bytes((_VERSION,)) + struct.pack("<Q", start_us), _message("B", bytes(_FLAG_BYTES))]
    parts += [_message("F", topic.definition.encode("ascii")) for topic in topics]
    parts += [_information(key, value) for key, value in facts.items()]
    parts += [_message("A", struct.pack("<BH", 0, number) + topic.name.encode("ascii")) for number, topic in enumerate(topics)]
    return b"".join(parts)


def _information(key: str, value: str) -> bytes:
    data = value.encode("ascii", "replace")
    declared = f"char[{len(data)}] {key}".encode("ascii")
    return _message("I", bytes((len(declared),)) + declared + data)


def sample(number: int, packed: bytes) -> bytes:
    """A sample of the topic with this number."""
    return _message("D", struct.pack("<H", number) + packed)


def text(time_us: int, severity: int, words: str) -> bytes:
    """A logged text. `severity`: 0 emergency to 7 debug."""
    return _message("L", bytes((ord("0") + severity,)) + struct.pack("<Q", time_us) + words.encode("ascii", "replace"))
