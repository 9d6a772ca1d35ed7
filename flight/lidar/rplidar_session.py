"""RPLIDAR's handshake: stop, info, health, scan mode, motor, scan."""

from __future__ import annotations

import struct

from flight.lidar import rplidar
from flight.lidar.rplidar import Answer, RplidarError, format_name
from flight.lidar.rplidar_decoders import CapsuleDecoder, StandardDecoder
from flight.lidar.serial_port import SerialTransport
from flight.lidar.session import POLL_S, Host
from flight.lidar.spinning_session import StreamKind
from flight.lidar.transport import Transport, TransportError

RANGE_MIN_M = 0.05
RANGE_MAX_M = 12.0
"""Where the device does not say: the A1 and most of the A2."""

_STOP_PAUSE_S = 0.1
_MODES_SINCE = (1, 24)  # firmware that answers questions about its scan modes
_MAX_MODES = 16
_KINDS = {"standard": rplidar.STANDARD, "express": rplidar.EXPRESS, "dense": rplidar.DENSE}
_DRAIN_READS = 64


class RplidarStarter:
    """See `spinning_session.Starter`."""

    def __init__(self, transport: Transport, host: Host) -> None:
        self._transport = transport
        self._host = host
        self._wait_s = host.config.reply_timeout_s
        self._reader = rplidar.AnswerReader()

    def start(self) -> StreamKind:
        """Bring the device from any state to streaming. Raises `RplidarError` or `TransportError`."""
        self.stop()
        self._drain()
        info = rplidar.decode_info(self._ask(rplidar.request(rplidar.GET_INFO), "its info"))
        self._check_health()
        mode, kind, sample_s, far_m = self._choose_mode(info)
        self._start_motor()
        standard = kind == rplidar.STANDARD and mode is None
        command = rplidar.request(rplidar.SCAN) if standard else rplidar.express_request(mode or 0)
        answer = self._ask(command, "the scan command")
        if answer.kind != kind:
            sent = format_name(answer.kind)
            raise RplidarError(f"asked for scan format {format_name(kind)}, the LiDAR sends {sent}: set lidar.rplidar_mode")
        name = f"RPLIDAR model {info.model:02X}, firmware {info.firmware[0]}.{info.firmware[1]:02d}, format {kind:02X}"
        frame_bytes = rplidar.NODE_BYTES if kind == rplidar.STANDARD else rplidar.CAPSULE_BYTES
        return StreamKind(name, _decoder(kind, sample_s), RANGE_MIN_M, far_m, frame_bytes, first_bytes=self._reader.rest)

    def stop(self) -> None:
        """Stop the stream (the motor goes on: it stops by itself, or with its power)."""
        self._transport.write(rplidar.request(rplidar.STOP), self._wait_s)

    def _drain(self) -> None:
        """Throw away what the device had sent before it heard the stop. A device that talks on is not one of ours."""
        self._host.stop.wait(_STOP_PAUSE_S)
        for _ in range(_DRAIN_READS):
            if not self._transport.read(0.02):
                return
        raise TransportError("the LiDAR does not stop sending: is it another kind, or another baud rate?")

    def _check_health(self) -> None:
        status, code = rplidar.decode_health(self._ask(rplidar.request(rplidar.GET_HEALTH), "its health"))
        if status >= 2:
            self._transport.write(rplidar.request(rplidar.RESET), self._wait_s)
            raise RplidarError(f"the LiDAR reports an error (health {status}, code {code:04X}): it was reset; power-cycle it")

    def _choose_mode(self, info: rplidar.DeviceInfo) -> tuple[int | None, int, float, float]:
        """(mode to ask for or None for the plain scan, answer format, seconds per sample, range in m)."""
        wanted = self._host.config.rplidar_mode
        if info.firmware < _MODES_SINCE:
            return self._old_mode(wanted)
        (count,) = struct.unpack_from("<H", self._conf(rplidar.CONF_MODE_COUNT, 2))
        (typical,) = struct.unpack_from("<H", self._conf(rplidar.CONF_TYPICAL_MODE, 2))
        kinds = {mode: self._conf(rplidar.CONF_ANSWER_TYPE, 1, mode)[0] for mode in range(min(count, _MAX_MODES))}
        mode = _pick(kinds, typical, wanted)
        (sample_q8,) = struct.unpack_from("<I", self._conf(rplidar.CONF_US_PER_SAMPLE, 4, mode))
        (far_q8,) = struct.unpack_from("<I", self._conf(rplidar.CONF_MAX_DISTANCE, 4, mode))
        return mode, kinds[mode], _sample_s(sample_q8 / 256.0), far_q8 / 256.0 if 1 <= far_q8 >> 8 <= 100 else RANGE_MAX_M

    def _old_mode(self, wanted: str) -> tuple[int | None, int, float, float]:
        standard_us, express_us = rplidar.decode_sample_rate(
            self._ask(rplidar.request(rplidar.GET_SAMPLE_RATE), "its sample rate")
        )
        if wanted == "dense":
            raise RplidarError("this LiDAR's firmware has no dense mode: set lidar.rplidar_mode to auto, standard or express")
        if wanted == "standard":
            return None, rplidar.STANDARD, _sample_s(standard_us), RANGE_MAX_M
        return 0, rplidar.EXPRESS, _sample_s(express_us), RANGE_MAX_M

    def _conf(self, key: int, least_bytes: int, mode: int | None = None) -> bytes:
        value = rplidar.decode_conf(self._ask(rplidar.conf_request(key, mode), f"configuration {key:02X}"), key)
        if len(value) < least_bytes:
            raise RplidarError(f"configuration {key:02X} has {len(value)} bytes instead of {least_bytes}")
        return value

    def _start_motor(self) -> None:
        config = self._host.config
        if isinstance(self._transport, SerialTransport):
            self._transport.set_dtr(False)  # the A1's motor turns while DTR is low
        if config.motor_pwm is not None:
            self._transport.write(rplidar.request(rplidar.SET_MOTOR_PWM, struct.pack("<H", config.motor_pwm)), self._wait_s)
        if config.motor_rpm is not None:
            self._transport.write(rplidar.request(rplidar.SET_MOTOR_RPM, struct.pack("<H", config.motor_rpm)), self._wait_s)

    def _ask(self, message: bytes, what: str) -> Answer:
        self._transport.write(message, self._wait_s)
        deadline_s = self._host.now() + self._wait_s
        while not self._host.stop.is_set():
            remaining_s = deadline_s - self._host.now()
            if remaining_s <= 0.0:
                raise TransportError(f"the LiDAR did not answer the question for {what} within {self._wait_s:g} s")
            answers = self._reader.feed(self._transport.read(min(remaining_s, POLL_S)))
            if answers:
                return answers[0]
        raise TransportError("the driver was closed")


def _pick(kinds: dict[int, int], typical: int, wanted: str) -> int:
    """The mode asked for; for `auto` the device's typical one if its format is known here, else the richest that is."""
    if wanted == "auto":
        if kinds.get(typical) in _KINDS.values():
            return typical
        order = [rplidar.DENSE, rplidar.EXPRESS, rplidar.STANDARD]
    else:
        order = [_KINDS[wanted]]
    for kind in order:
        fitting = [mode for mode, offered in kinds.items() if offered == kind]
        if fitting:
            return typical if typical in fitting else fitting[-1]
    offered = ", ".join(sorted({format_name(kind) for kind in kinds.values()})) or "none"
    if not set(kinds.values()) & set(rplidar.READABLE):
        raise RplidarError(f"this LiDAR offers the formats {offered}; standard, express or dense is needed")
    raise RplidarError(f"this LiDAR offers the formats {offered}, none of them is {wanted}: set lidar.rplidar_mode")


def _sample_s(microseconds: float) -> float:
    if not 1.0 <= microseconds <= 10_000.0:
        raise RplidarError(f"the LiDAR says {microseconds:g} us per sample")
    return 1e-6 * microseconds


def _decoder(kind: int, sample_s: float) -> StandardDecoder | CapsuleDecoder:
    if kind == rplidar.STANDARD:
        return StandardDecoder(sample_s)
    return CapsuleDecoder(sample_s, dense=kind == rplidar.DENSE)
