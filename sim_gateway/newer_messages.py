"""MAVLink messages that PX4 v1.17 sends and the installed MAVLink library does not know: defined as in MAVLink's common set.

A client that does not know them either passes them over; MAVSDK does know them.
"""

from __future__ import annotations

import struct
from typing import Any, ClassVar

from pymavlink.dialects.v20 import development as mav
from pymavlink.generator.mavcrc import x25crc

_CODES = {"uint8_t": "B", "uint16_t": "H", "uint32_t": "I", "int32_t": "i", "uint64_t": "Q"}
Fields = tuple[tuple[str, str, int], ...]  # type, name, elements (0: no array)


def _fields(text: str) -> Fields:
    """`type name` or `type[n] name`, separated by commas."""
    found = []
    for part in text.split(","):
        kind, name = part.split()
        base, _, length = kind.rstrip("]").partition("[")
        found.append((base, name, int(length or 0)))
    return tuple(found)


def _on_the_wire(fields: Fields) -> Fields:
    """Largest types first, else in the order of the definition."""
    return tuple(sorted(fields, key=lambda field: -struct.calcsize(_CODES[field[0]])))


def crc_extra(name: str, fields: Fields) -> int:
    """The byte that keeps two definitions of a message apart."""
    crc = x25crc()
    crc.accumulate_str(f"{name} ")
    for kind, field, length in _on_the_wire(fields):
        crc.accumulate_str(f"{kind} {field} ")
        if length:
            crc.accumulate([length])
    return int((crc.crc & 0xFF) ^ (crc.crc >> 8))


class NewerMessage(mav.MAVLink_message):  # type: ignore[misc]
    """A message with fields by name; subclasses give id, name and definition."""

    id: ClassVar[int]
    msgname: ClassVar[str]
    definition: ClassVar[str]

    def __init_subclass__(cls) -> None:
        """What pymavlink's generator writes into each message: layout on the wire and the byte against other definitions."""
        fields = _fields(cls.definition)
        wire = _on_the_wire(fields)
        cls.fieldnames = [name for _, name, _ in fields]
        cls.ordered_fieldnames = [name for _, name, _ in wire]
        cls.array_lengths = [length for _, _, length in wire]
        cls.unpacker = struct.Struct("<" + "".join(f"{length or ''}{_CODES[kind]}" for kind, _, length in wire))
        cls.crc_extra = crc_extra(cls.msgname, fields)

    def __init__(self, **values: Any) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        self._instance_field, self._instance_offset = None, -1
        for name in self.fieldnames:
            setattr(self, name, values[name])

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """The frame."""
        values = [getattr(self, name) for name in self.ordered_fieldnames]
        flat = [item for value in values for item in (value if isinstance(value, list) else [value])]
        return bytes(self._pack(mav, self.crc_extra, self.unpacker.pack(*flat), force_mavlink1=force_mavlink1))


class LinkNodeStatus(NewerMessage):
    """What a link has carried."""

    id, msgname = 8, "LINK_NODE_STATUS"
    definition = (
        "uint64_t timestamp, uint8_t tx_buf, uint8_t rx_buf, uint32_t tx_rate, uint32_t rx_rate, uint16_t rx_parse_err, "
        "uint16_t tx_overflows, uint16_t rx_overflows, uint32_t messages_sent, uint32_t messages_received, uint32_t messages_lost"
    )


class TimeEstimateToTarget(NewerMessage):
    """Seconds to several targets; -1: unknown."""

    id, msgname = 380, "TIME_ESTIMATE_TO_TARGET"
    definition = "int32_t safe_return, int32_t land, int32_t mission_next_item, int32_t mission_end, int32_t commanded_action"


class CurrentEventSequence(NewerMessage):
    """Number of the newest event."""

    id, msgname = 411, "CURRENT_EVENT_SEQUENCE"
    definition = "uint16_t sequence, uint8_t flags"


NEWER_IDS = {kind.msgname: kind.id for kind in (LinkNodeStatus, TimeEstimateToTarget, CurrentEventSequence)}
