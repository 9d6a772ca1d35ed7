"""SCIP 2.x (Hokuyo): bytes in, replies and scans out. No I/O, bounded memory, nothing but numpy.

A reply is `echo LF status sum LF {data sum LF} LF`: the empty line ends it. The sum of a line is the low six
bits of the sum of its bytes, plus 0x30. Numbers are cut into 6-bit groups, most significant first, each plus 0x30.

The sum cannot see a flip of the bits 0x40 and 0x80 of a byte, so every data byte is also required to lie in the
alphabet 0x30..0x6F, and every data line but the last to be exactly 64 characters: together these catch every
single flipped bit. The echo carries no sum at all: it must be the request's, character by character.

Protocol facts: C-42-03320 (SCIP 2.0), UXM-30LX-EW specification C-42-03907.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAX_REPLY_BYTES = 32 * 1024
"""Longest reply kept while waiting for its end. The longest MD scan of a UST-20LX (1081 steps) is 3.4 kB."""

DATA_LINE_CHARACTERS = 64
STATUS_OK = "00"
STATUS_STREAM = "99"
STATUS_UNSTABLE = "0M"
_LOW, _HIGH = 0x30, 0x6F
_MAX_STEP = 9999
_MAX_RANGE_MM = 2**18 - 1

CODE_NO_ECHO = 1
CODE_TOO_NEAR = 2


class ScipError(ValueError):
    """A reply that breaks the protocol; the message says which rule."""


class ScipChecksumError(ScipError):
    """A line whose sum does not match, or that holds a byte outside the alphabet."""


@dataclass(frozen=True, slots=True)
class Reply:
    """One reply: `lines` still carry their sums (their meaning depends on the command)."""

    echo: str
    status: str
    lines: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class ScipParameters:
    """What the device says of itself (`PP`). Ranges in mm, angles in steps, `scan_rpm` in revolutions a minute."""

    model: str
    range_min_mm: int
    range_max_mm: int
    steps_per_turn: int
    first_step: int
    last_step: int
    front_step: int
    scan_rpm: int

    @property
    def beams(self) -> int:
        """Steps of a full scan."""
        return self.last_step - self.first_step + 1

    @property
    def angle_min_rad(self) -> float:
        """Bearing of the first step, positive left."""
        return (self.first_step - self.front_step) * self.angle_increment_rad

    @property
    def angle_increment_rad(self) -> float:
        """Angle between steps."""
        return 2.0 * math.pi / self.steps_per_turn


@dataclass(frozen=True, slots=True)
class ScipScan:
    """One scan as sent. `values_mm`: int32 [beams], codes below the device's minimum range included.

    `timestamp_ms`: the device's 24-bit clock at step 0 of the scan.
    """

    timestamp_ms: int
    values_mm: NDArray[np.int32]


def checksum(line: bytes) -> int:
    """The sum character of a line."""
    return (sum(line) & 0x3F) + 0x30


def request(code: str, parameters: str = "") -> bytes:
    """A request on the wire, for example `request("PP")`."""
    return f"{code}{parameters}\n".encode("ascii")


def stream_request(first_step: int, last_step: int, *, skip: int = 0) -> bytes:
    """`MD` for all steps of the range, endlessly. `skip`: scans left out between two sent ones, 0..9."""
    if not (0 <= first_step <= last_step <= _MAX_STEP and 0 <= skip <= 9):
        raise ScipError(f"no MD request for steps {first_step}..{last_step} skip {skip}: want 0 <= first <= last <= 9999")
    return request("MD", f"{first_step:04d}{last_step:04d}01{skip:d}00")


class ReplyReader:
    """Cuts a byte stream into replies. Feed it anything in any chunks; it never raises and never grows.

    `bad_frames` counts replies refused for their form, `bad_checksums` those whose status line's sum is wrong.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._skipping = False
        self.bad_frames = 0
        self.bad_checksums = 0

    @property
    def buffered_bytes(self) -> int:
        """Bytes held while a reply is incomplete: at most `MAX_REPLY_BYTES`."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Reply]:
        """The replies that these bytes complete, oldest first."""
        search_from = max(0, len(self._buffer) - 1)
        self._buffer += data
        replies: list[Reply] = []
        start = 0
        while (end := self._buffer.find(b"\n\n", search_from)) >= 0:
            self._take(bytes(self._buffer[start:end]), replies)
            start = search_from = end + 2
        del self._buffer[:start]
        self._drop_overlong()
        return replies

    def _take(self, frame: bytes, replies: list[Reply]) -> None:
        if self._skipping:
            self._skipping = False
            return
        frame = frame.lstrip(b"\n")
        if not frame:
            return
        if len(frame) > MAX_REPLY_BYTES:
            self.bad_frames += 1
            return
        try:
            replies.append(_parse_reply(frame))
        except ScipChecksumError:
            self.bad_checksums += 1
        except ScipError:
            self.bad_frames += 1

    def _drop_overlong(self) -> None:
        if len(self._buffer) <= MAX_REPLY_BYTES:
            return
        if not self._skipping:
            self.bad_frames += 1
        self._skipping = True
        del self._buffer[:-1]  # the last byte may be the first half of the empty line


def _parse_reply(frame: bytes) -> Reply:
    lines = frame.split(b"\n")
    if len(lines) < 2:
        raise ScipError("a reply needs an echo and a status line")
    echo, status = lines[0], lines[1]
    if not echo or any(not 0x20 <= byte <= 0x7E for byte in echo):
        raise ScipError("the echo is not printable ASCII")
    if len(status) != 3:
        raise ScipError("a status line is two characters and a sum")
    return Reply(echo.decode("ascii"), _stripped(status).decode("ascii"), tuple(lines[2:]))


def _stripped(line: bytes) -> bytes:
    """The line without its sum, which is checked together with the alphabet."""
    body = line[:-1]
    if not body or checksum(body) != line[-1]:
        raise ScipChecksumError(f"wrong sum in a line of {len(line)} bytes")
    if min(line) < _LOW or max(line) > _HIGH:
        raise ScipChecksumError("a byte outside 0x30..0x6F")
    return body


def decode_number(characters: bytes) -> int:
    """A number of 6-bit characters, most significant first."""
    value = 0
    for character in characters:
        if not _LOW <= character <= _HIGH:
            raise ScipError("a byte outside 0x30..0x6F")
        value = (value << 6) | (character - _LOW)
    return value


def decode_timestamp(line: bytes) -> int:
    """The device clock, ms modulo 2^24, of a timestamp line with its sum."""
    body = _stripped(line)
    if len(body) != 4:
        raise ScipError(f"a timestamp is 4 characters, not {len(body)}")
    return decode_number(body)


def decode_clock(reply: Reply) -> int:
    """The device clock, ms modulo 2^24, of a `TM1` reply."""
    if reply.status != STATUS_OK or len(reply.lines) != 1:
        raise ScipError(f"TM1 answered status {reply.status} with {len(reply.lines)} lines")
    return decode_timestamp(reply.lines[0])


def decode_scan(reply: Reply, sent: bytes, beams: int) -> ScipScan:
    """The scan of one `MD` reply.

    `sent`: the request as written (its steps must come back unchanged), `beams`: values expected.
    Raises `ScipChecksumError` or `ScipError`; a scan that comes back has no bad line.
    """
    expected = sent.decode("ascii").rstrip("\n")
    if reply.echo[:-2] != expected[:-2] or not reply.echo[-2:].isdigit():
        raise ScipError("the echo is not that of the stream's request")
    if reply.status != STATUS_STREAM:
        raise ScipError(f"scan with status {reply.status}")
    if not reply.lines:
        raise ScipError("scan without a timestamp")
    timestamp_ms = decode_timestamp(reply.lines[0])
    return ScipScan(timestamp_ms, _decode_values(reply.lines[1:], beams))


def _decode_values(lines: tuple[bytes, ...], beams: int) -> NDArray[np.int32]:
    """int32 [beams] of 3-character values; a value may straddle two lines."""
    total = 3 * beams
    if len(lines) != math.ceil(total / DATA_LINE_CHARACTERS):
        raise ScipError(f"{len(lines)} data lines for {beams} beams")
    bodies = [_stripped(line) for line in lines]
    if any(len(body) != DATA_LINE_CHARACTERS for body in bodies[:-1]):
        raise ScipError(f"a data line is not {DATA_LINE_CHARACTERS} characters")
    stream = b"".join(bodies)
    if len(stream) != total:
        raise ScipError(f"{len(stream)} characters for {beams} beams")
    groups = np.frombuffer(stream, dtype=np.uint8).astype(np.int32).reshape(beams, 3) - _LOW
    return (groups[:, 0] << 12) | (groups[:, 1] << 6) | groups[:, 2]


def ranges_from_values(values_mm: NDArray[np.int32], range_min_mm: int, range_max_mm: int) -> NDArray[np.float32]:
    """float32 [beams] in m: code "no echo" and values past the maximum are `inf`, "too near" is 0, other codes `nan`."""
    ranges = values_mm.astype(np.float32) * np.float32(1e-3)
    codes = values_mm < range_min_mm
    ranges[codes] = np.nan
    ranges[codes & (values_mm == CODE_TOO_NEAR)] = 0.0
    ranges[(codes & (values_mm == CODE_NO_ECHO)) | (values_mm > range_max_mm)] = np.inf
    return ranges


def decode_parameters(reply: Reply) -> ScipParameters:
    """The `PP` reply. Raises `ScipError` naming the field that is missing or impossible."""
    if reply.status != STATUS_OK:
        raise ScipError(f"PP answered status {reply.status}")
    fields = _key_values(reply.lines)
    numbers = {key: _whole_number(fields, key) for key in ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")}
    parameters = ScipParameters(
        model=fields.get("MODL", "unknown")[:64],
        range_min_mm=numbers["DMIN"],
        range_max_mm=numbers["DMAX"],
        steps_per_turn=numbers["ARES"],
        first_step=numbers["AMIN"],
        last_step=numbers["AMAX"],
        front_step=numbers["AFRT"],
        scan_rpm=numbers["SCAN"],
    )
    _check_parameters(parameters)
    return parameters


def _key_values(lines: Iterable[bytes]) -> dict[str, str]:
    """`KEY:VALUE;sum` lines. Devices differ on whether the sum covers the `;`: both are accepted here, and only here."""
    fields: dict[str, str] = {}
    for line in lines:
        body = line[:-2]
        if len(line) < 4 or line[-2:-1] != b";" or line[-1] not in (checksum(body), checksum(line[:-1])):
            raise ScipChecksumError("wrong sum or form in an information line")
        key, separator, value = body.decode("ascii", errors="replace").partition(":")
        if separator:
            fields[key] = value
    return fields


def _whole_number(fields: dict[str, str], key: str) -> int:
    text = fields.get(key, "")
    if not (text.isascii() and text.isdigit() and len(text) <= 7):
        raise ScipError(f"PP field {key} is {text[:16]!r}, not a number")
    return int(text)


def _check_parameters(parameters: ScipParameters) -> None:
    p = parameters
    if not 0 < p.range_min_mm < p.range_max_mm <= _MAX_RANGE_MM:
        raise ScipError(f"PP ranges {p.range_min_mm}..{p.range_max_mm} mm are impossible")
    if not (0 <= p.first_step < p.last_step <= _MAX_STEP and p.first_step <= p.front_step <= p.last_step):
        raise ScipError(f"PP steps {p.first_step}..{p.last_step} front {p.front_step} are impossible")
    if not p.beams <= p.steps_per_turn <= _MAX_STEP + 1:
        raise ScipError(f"PP says {p.steps_per_turn} steps a turn for {p.beams} beams")
    if not 0 < p.scan_rpm <= 60_000:
        raise ScipError(f"PP says {p.scan_rpm} revolutions a minute")
