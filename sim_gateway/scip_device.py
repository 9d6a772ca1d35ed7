"""A Hokuyo-like laser scanner that speaks SCIP 2.x: request lines in, reply bytes out, no I/O.

Protocol facts: SCIP 2.x as Hokuyo's UST series speaks it. Where the protocol leaves a choice open:

* A request longer than `MAX_LINE` is cut there and answered `0D`.
* Single-scan requests answer with the newest scan; before the first scan they answer `0M` (not stable yet).
* After a counted multi-scan the laser returns to what it was before; a new multi-scan replaces the running one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

MAX_LINE = 64
NO_ECHO = 1  # range codes below DMIN
TOO_NEAR = 2
OTHER_ERROR = 5
_USER_STRING_MAX = 16
_ABSURD = 2.0  # times the range: no noise makes this
_LARGEST = 0xFFFF
_BLOCK = 64  # characters of scan data per checked line
_STANDBY, _SINGLE, _MULTI, _TIME = "standby", "single", "multi", "time"
_STATE_CODES = {_STANDBY: b"000", _TIME: b"002", _SINGLE: b"003", _MULTI: b"004"}


@dataclass(frozen=True, slots=True)
class ScipGeometry:
    """Steps and limits of the device. Step angle = 2 pi (step - front) / steps_per_turn, positive to the left."""

    steps_per_turn: int = 720
    front_step: int = 360
    first_step: int = 180
    last_step: int = 540
    range_min_mm: int = 100
    range_max_mm: int = 4000
    rate_hz: int = 20

    @property
    def steps(self) -> int:
        """Number of ranges in a full scan."""
        return self.last_step - self.first_step + 1

    def bearings_rad(self) -> NDArray[np.float64]:
        """Bearing of each step of a full scan, float64 [steps], 0 ahead, positive left."""
        return 2.0 * np.pi * (np.arange(self.first_step, self.last_step + 1) - self.front_step) / self.steps_per_turn

    def codes(self, ranges_m: NDArray[np.floating]) -> NDArray[np.int64]:
        """Ranges in metres to what the device sends: millimetres, or a code where there is none.

        `inf` or beyond the range: `NO_ECHO`; below the range, 0 included: `TOO_NEAR`; NaN: `OTHER_ERROR`.
        """
        ranges = np.asarray(ranges_m, dtype=np.float64)
        if ranges.shape != (self.steps,):
            raise ValueError(f"scan has shape {ranges.shape}: this device has {self.steps} steps")
        mm = np.rint(np.nan_to_num(ranges, nan=0.0, posinf=1e6, neginf=0.0) * 1000.0)
        codes = np.where(mm > self.range_max_mm, NO_ECHO, np.where(mm < self.range_min_mm, TOO_NEAR, mm))
        return np.where(np.isnan(ranges), OTHER_ERROR, codes).astype(np.int64)

    def sent_codes(self, ranges_m: NDArray[np.floating]) -> NDArray[np.int64]:
        """As `codes`, of a device that may be faulty: fewer steps break off, a number far beyond the range is sent as it is."""
        ranges = np.full(self.steps, np.inf)
        ranges[: ranges_m.size] = ranges_m[: self.steps]
        codes = self.codes(ranges)
        absurd = np.isfinite(ranges) & (ranges > _ABSURD * self.range_max_mm * 1e-3)
        codes[absurd] = np.minimum(np.rint(ranges[absurd] * 1000.0), _LARGEST).astype(np.int64)
        return codes[: ranges_m.size]


@dataclass(frozen=True, slots=True)
class _Request:
    """A scan request: `head` is its echo without the trailing scan count."""

    head: bytes
    tail: bytes  # user string with its ';', echoed
    start: int
    end: int
    group: int
    characters: int
    skip: int = 0
    remaining: int = 0
    endless: bool = False


def checksum(line: bytes) -> bytes:
    """The one character that ends a checked line: the low six bits of the sum of its bytes, plus 0x30."""
    return bytes([(sum(line) & 0x3F) + 0x30])


def encode(values: NDArray[np.int64], characters: int) -> bytes:
    """Values as `characters` six-bit digits each, most significant first, plus 0x30."""
    shifts = 6 * np.arange(characters - 1, -1, -1)
    return (((values[:, None] >> shifts) & 0x3F) + 0x30).astype(np.uint8).tobytes()


def _checked(line: bytes) -> bytes:
    return line + checksum(line) + b"\n"


def _message(echo: bytes, status: bytes, body: bytes = b"") -> bytes:
    return echo + b"\n" + _checked(status) + body + b"\n"


def _info(entries: dict[str, object]) -> bytes:
    lines = [f"{key}:{value}".encode("ascii") for key, value in entries.items()]
    return b"".join(line + b";" + checksum(line) + b"\n" for line in lines)


class ScipDevice:
    """The instrument behind the socket. `clock` returns the simulator's time in seconds; the device timer runs on it."""

    def __init__(self, clock: Callable[[], float], geometry: ScipGeometry | None = None) -> None:
        self.geometry = geometry or ScipGeometry()
        self._clock = clock
        self._zero_s = 0.0
        self._state = _STANDBY
        self._state_after = _STANDBY
        self._stream: _Request | None = None
        self._skipped = 0
        self._newest: tuple[float, NDArray[np.int64]] | None = None
        self._handlers: dict[bytes, tuple[int, Callable[[bytes, bytes], bytes]]] = {
            b"VV": (0, self._version),
            b"PP": (0, self._parameters),
            b"II": (0, self._status),
            b"BM": (0, self._laser_on),
            b"QT": (0, self._quit),
            b"RS": (0, self._reset),
            b"%ST": (0, self._report_state),
            b"TM": (1, self._time_adjust),
            b"GD": (10, self._single_scan),
            b"GS": (10, self._single_scan),
            b"MD": (13, self._multi_scan),
            b"MS": (13, self._multi_scan),
            b"SS": (6, lambda echo, _: _message(echo, b"0F")),  # no bit rate on Ethernet
        }

    @property
    def state(self) -> str:
        """`standby`, `single` (laser on), `multi` (streaming) or `time` (time adjustment)."""
        return self._state

    def disconnect(self) -> None:
        """The client has gone: stop streaming, laser off."""
        self._state, self._stream = _STANDBY, None

    def handle(self, line: bytes) -> bytes:
        """Reply to one request line (without its line feed)."""
        if len(line) > MAX_LINE:
            return _message(line[:MAX_LINE], b"0D")
        request, _, user_string = line.partition(b";")
        width = 3 if request[:1] == b"%" else 2
        code, parameters = request[:width], request[width:]
        if code not in self._handlers:
            return _message(line, b"0E")
        if len(user_string) > _USER_STRING_MAX:
            return _message(line, b"0G")
        expected, handler = self._handlers[code]
        if len(parameters) != expected:
            return _message(line, b"0H" if len(parameters) < expected else b"0D")
        return handler(line, parameters)

    def new_scan(self, time_s: float, codes: NDArray[np.int64]) -> bytes:
        """Take a full scan measured at `time_s` (simulator); returns what a running multi-scan sends for it."""
        self._newest = (time_s, codes)
        request = self._stream
        if request is None:
            return b""
        if self._skipped < request.skip:
            self._skipped += 1
            return b""
        self._skipped = 0
        if not request.endless:
            request = replace(request, remaining=request.remaining - 1)
            self._stream = request
            if request.remaining == 0:
                self._stream, self._state = None, self._state_after
        return _message(request.head + b"%02d" % request.remaining + request.tail, b"99", self._scan_body(request))

    def _timer_ms(self, time_s: float) -> int:
        return int((time_s - self._zero_s) * 1000.0 + 1e-6) & 0xFFFFFF

    def _timestamp(self, time_s: float) -> bytes:
        return _checked(encode(np.array([self._timer_ms(time_s)]), 4))

    def _scan_body(self, request: _Request) -> bytes:
        assert self._newest is not None
        time_s, codes = self._newest
        first = self.geometry.first_step
        values = _grouped(codes[request.start - first : request.end - first + 1], request.group, self.geometry.range_min_mm)
        stream = encode(values, request.characters)
        return self._timestamp(time_s) + b"".join(_checked(stream[i : i + _BLOCK]) for i in range(0, len(stream), _BLOCK))

    def _version(self, echo: bytes, _: bytes) -> bytes:
        entries = {"VEND": "Simulated", "PROD": "SCIP scanner emulator", "FIRM": "1.0", "PROT": "SCIP 2.2", "SERI": "S0000001"}
        return _message(echo, b"00", _info(dict(entries)))

    def _parameters(self, echo: bytes, _: bytes) -> bytes:
        if self._state == _TIME:
            return _message(echo, b"10")
        g = self.geometry
        limits = {"MODL": "SIM-180", "DMIN": g.range_min_mm, "DMAX": g.range_max_mm, "ARES": g.steps_per_turn}
        steps = {"AMIN": g.first_step, "AMAX": g.last_step, "AFRT": g.front_step, "SCAN": 60 * g.rate_hz}
        return _message(echo, b"00", _info({**limits, **steps}))

    def _status(self, echo: bytes, _: bytes) -> bytes:
        laser = "ON" if self._state in (_SINGLE, _MULTI) else "OFF"
        timer = f"{self._timer_ms(self._clock()):06X}"
        entries = {"MODL": "SIM-180", "LASR": laser, "SCSP": 60 * self.geometry.rate_hz, "MESM": self._state}
        return _message(echo, b"00", _info({**entries, "SBPS": "Ethernet", "TIME": timer, "STAT": "stable"}))

    def _laser_on(self, echo: bytes, _: bytes) -> bytes:
        if self._state == _TIME:
            return _message(echo, b"10")
        if self._state != _STANDBY:
            return _message(echo, b"02")
        self._state = _SINGLE
        return _message(echo, b"00")

    def _quit(self, echo: bytes, _: bytes) -> bytes:
        self.disconnect()
        return _message(echo, b"00")

    def _reset(self, echo: bytes, _: bytes) -> bytes:
        self.disconnect()
        self._zero_s = self._clock()
        return _message(echo, b"00")

    def _report_state(self, echo: bytes, _: bytes) -> bytes:
        return _message(echo, b"00", _checked(_STATE_CODES[self._state]))

    def _time_adjust(self, echo: bytes, code: bytes) -> bytes:
        inside = self._state == _TIME
        if code == b"0":
            if self._state in (_SINGLE, _MULTI):
                return _message(echo, b"10")
            self._state = _TIME
            return _message(echo, b"02" if inside else b"00")
        if code == b"1":
            return _message(echo, b"00", self._timestamp(self._clock())) if inside else _message(echo, b"04")
        if code == b"2":
            self._state = _STANDBY if inside else self._state
            return _message(echo, b"00" if inside else b"03")
        return _message(echo, b"01")

    def _single_scan(self, echo: bytes, parameters: bytes) -> bytes:
        request = self._parse(echo, parameters)
        if isinstance(request, bytes):
            return _message(echo, request)
        if self._state != _SINGLE:
            return _message(echo, b"10")
        if self._newest is None:
            return _message(echo, b"0M")
        return _message(echo, b"00", self._scan_body(request))

    def _multi_scan(self, echo: bytes, parameters: bytes) -> bytes:
        request = self._parse(echo, parameters)
        if isinstance(request, bytes):
            return _message(echo, request)
        if not parameters[10:11].isdigit():
            return _message(echo, b"06")
        if not parameters[11:13].isdigit():
            return _message(echo, b"07")
        if self._state == _TIME:
            return _message(echo, b"10")
        count = int(parameters[11:13])
        self._state_after = self._state if self._state != _MULTI else self._state_after
        self._state, self._skipped = _MULTI, 0
        self._stream = replace(request, head=echo[:13], skip=int(parameters[10:11]), remaining=count, endless=count == 0)
        return _message(echo, b"00")

    def _parse(self, echo: bytes, parameters: bytes) -> _Request | bytes:
        """The request, or the status that refuses it."""
        fields = parameters[0:4], parameters[4:8], parameters[8:10]
        for status, field in zip((b"01", b"02", b"03"), fields, strict=True):
            if not field.isdigit():
                return status
        start, end, group = (int(field) for field in fields)
        if start < self.geometry.first_step or end > self.geometry.last_step:
            return b"04"
        if end < start:
            return b"05"
        _, separator, user_string = echo.partition(b";")
        return _Request(echo, separator + user_string, start, end, max(1, group), 3 if echo[1:2] == b"D" else 2)


def _grouped(codes: NDArray[np.int64], group: int, range_min_mm: int) -> NDArray[np.int64]:
    """One value per `group` adjacent steps: the nearest echo, or the smallest code where there is no echo."""
    if group == 1:
        return codes
    pieces = [codes[i : i + group] for i in range(0, len(codes), group)]
    return np.array([min((v for v in p if v >= range_min_mm), default=p.min()) for p in pieces], dtype=np.int64)
