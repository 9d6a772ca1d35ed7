"""Slamtec RPLIDAR: requests and answers, bytes only. The scans are read by `rplidar_decoders`. No I/O, bounded memory.

Little-endian. A request is A5, command[, size, payload, exclusive or of all bytes before]. An answer begins with A5 5A,
u32 (30 bits payload length, top 2 bits: 1 = repeats), u8 type.

Protocol facts: Slamtec/rplidar_sdk (sl_lidar_protocol.h, sl_lidar_cmd.h).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

STOP, RESET, SCAN, EXPRESS_SCAN = 0x25, 0x40, 0x20, 0x82
GET_INFO, GET_HEALTH, GET_SAMPLE_RATE, GET_CONF = 0x50, 0x52, 0x59, 0x84
SET_MOTOR_PWM, SET_MOTOR_RPM = 0xF0, 0xA8
INFO, HEALTH, SAMPLE_RATE, CONF = 0x04, 0x06, 0x15, 0x20
STANDARD, EXPRESS, DENSE = 0x81, 0x82, 0x85
CONF_MODE_COUNT, CONF_US_PER_SAMPLE, CONF_MAX_DISTANCE = 0x70, 0x71, 0x74
CONF_ANSWER_TYPE, CONF_TYPICAL_MODE = 0x75, 0x7C

CAPSULE_BYTES = 84
NODE_BYTES = 5
_PAYLOAD_BYTES = {INFO: (20, 20), HEALTH: (3, 3), SAMPLE_RATE: (4, 4), CONF: (4, 64)}
_STREAM_BYTES = {STANDARD: NODE_BYTES, EXPRESS: CAPSULE_BYTES, DENSE: CAPSULE_BYTES, 0x83: 781, 0x84: 132, 0x86: 170}
_STREAM_NAMES = {STANDARD: "standard", EXPRESS: "express", DENSE: "dense", 0x83: "HQ", 0x84: "ultra", 0x86: "ultra-dense"}
READABLE = (STANDARD, EXPRESS, DENSE)
"""Formats that `rplidar_decoders` reads; HQ, ultra and ultra-dense are only known by name."""

_ANSWER = b"\xa5\x5a"
_DESCRIPTOR_BYTES = 7
_MAX_CALL_BYTES = 16 * 1024


class RplidarError(ValueError):
    """An answer that breaks the protocol, or a device that cannot do what is asked; the message says which."""


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer. `payload` is empty for a stream: its data follow."""

    kind: int
    payload: bytes

    @property
    def streams(self) -> bool:
        """Whether scan data follow."""
        return self.kind in _STREAM_BYTES


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """What the device says of itself."""

    model: int
    firmware: tuple[int, int]
    hardware: int
    serial: str


def format_name(kind: int) -> str:
    """A scan format for the user: its number and what Slamtec calls it."""
    name = _STREAM_NAMES.get(kind, "unknown")
    return f"{kind:02X} ({name})" if kind in READABLE else f"{kind:02X} ({name}, not read here)"


def request(command: int, payload: bytes = b"") -> bytes:
    """A request on the wire. Commands with a payload have bit 7 set; the caller gives the command as documented."""
    if not command & 0x80:
        if payload:
            raise RplidarError(f"command {command:02X} takes no payload")
        return bytes((0xA5, command))
    message = bytes((0xA5, command, len(payload))) + payload
    check = 0
    for byte in message:
        check ^= byte
    return message + bytes((check,))


def express_request(mode: int) -> bytes:
    """Start the scan mode `mode` (0: the express mode of old firmware)."""
    return request(EXPRESS_SCAN, struct.pack("<BHH", mode, 0, 0))


def conf_request(key: int, mode: int | None = None) -> bytes:
    """Ask for a configuration value, padded to 36 bytes as the SDK sends it."""
    body = struct.pack("<I", key) + (struct.pack("<H", mode) if mode is not None else b"")
    return request(GET_CONF, body.ljust(36, b"\0"))


def decode_info(answer: Answer) -> DeviceInfo:
    """The `GET_INFO` answer."""
    model, minor, major, hardware = struct.unpack_from("<BBBB", _payload(answer, INFO))
    return DeviceInfo(model, (major, minor), hardware, answer.payload[4:20].hex().upper())


def decode_health(answer: Answer) -> tuple[int, int]:
    """(status: 0 good, 1 warning, 2 error; error code) of the `GET_HEALTH` answer."""
    status, code = struct.unpack("<BH", _payload(answer, HEALTH))
    return status, code


def decode_sample_rate(answer: Answer) -> tuple[int, int]:
    """Microseconds per sample, (standard, express), of the `GET_SAMPLE_RATE` answer."""
    standard, express = struct.unpack("<HH", _payload(answer, SAMPLE_RATE))
    return standard, express


def decode_conf(answer: Answer, key: int) -> bytes:
    """The value of a `GET_CONF` answer to `key`."""
    payload = _payload(answer, CONF)
    (answered,) = struct.unpack_from("<I", payload)
    if answered != key:
        raise RplidarError(f"asked for configuration {key:02X}, got {answered:02X}")
    return payload[4:]


def _payload(answer: Answer, kind: int) -> bytes:
    if answer.kind != kind:
        raise RplidarError(f"answer of type {answer.kind:02X} instead of {kind:02X}")
    return answer.payload


class AnswerReader:
    """Finds answers in the bytes of the handshake. Stops at a stream's answer: `rest` then holds the stream's first bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.rest = b""

    @property
    def buffered_bytes(self) -> int:
        """At most one unfinished answer."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Answer]:
        """The answers that these bytes complete; what is not one is skipped."""
        self._buffer += data[-_MAX_CALL_BYTES:]
        answers: list[Answer] = []
        while (answer := self._next()) is not None:
            answers.append(answer)
            if answer.streams:
                self.rest = bytes(self._buffer)
                self._buffer.clear()
                break
        return answers

    def _next(self) -> Answer | None:
        while (place := self._buffer.find(_ANSWER)) >= 0:
            if len(self._buffer) < place + _DESCRIPTOR_BYTES:
                del self._buffer[:place]
                return None
            size_word, kind = struct.unpack_from("<IB", self._buffer, place + 2)
            size = size_word & 0x3FFFFFFF
            if size_word >> 30 == 1 and _STREAM_BYTES.get(kind) == size:
                del self._buffer[: place + _DESCRIPTOR_BYTES]
                return Answer(kind, b"")
            low, high = _PAYLOAD_BYTES.get(kind, (1, 0))
            if not low <= size <= high:
                del self._buffer[: place + 1]
                continue
            end = place + _DESCRIPTOR_BYTES + size
            if len(self._buffer) < end:
                del self._buffer[:place]
                return None
            payload = bytes(self._buffer[place + _DESCRIPTOR_BYTES : end])
            del self._buffer[:end]
            return Answer(kind, payload)
        del self._buffer[: max(0, len(self._buffer) - 1)]
        return None
