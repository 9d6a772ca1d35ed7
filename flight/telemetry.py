"""Newest-wins store of what the vehicle says, each sample with the vehicle's own time on our monotonic clock.

MAVSDK hands messages over from its own thread, in order, as JSON. This module keeps only the newest of each kind (a
queue would hand out old data after a pause), maps `time_boot_ms` to the companion's clock, and refuses what cannot be
true: NaN, time running backwards, a foreign component. It has no I/O, so it is tested and replayed without a vehicle.
"""

from __future__ import annotations

import json
import math
from collections import deque
from dataclasses import dataclass

from flight.px4 import AUTOPILOT_COMPONENT, GRAVITY_M_S2, MODE_FLAG_ARMED, mode_of
from flight.self_report import Echo, SelfReport
from safety.frames import CorridorFrame, NedVector
from safety.messages import VehicleState

BUCKET_S = 1.0
MAX_DRIFT = 0.01
REBOOT_JUMP_S = 1.0
SLIP_TOLERANCE_S = 0.02
MAX_TEXTS = 100
MAX_MODE_CHANGES = 200
MAX_ROUND_TRIP_S = 5.0


class BootClock:
    """Vehicle boot time to our monotonic clock, by the smallest (arrival - boot) difference seen lately.

    The smallest difference belongs to the message that travelled fastest, so what remains in it is the least latency of
    the link (well under 1 ms on UDP, a few ms on a 921600 baud serial line). A smaller difference counts at once: it makes
    samples older, which is safe. A larger one is followed at `MAX_DRIFT` only: enough for any clock, while a link that
    turns slow shows up as age for long enough to end the flight, instead of being taken for drift. Only a clock that stood
    still (a paused simulator) may move the offset up at once, and only on proof: an answer to a question of ours, see `bound`.
    """

    def __init__(self) -> None:
        self._bucket_start_s = -math.inf
        self._previous = math.inf
        self._current = math.inf
        self._offset = math.inf
        self._arrival_s = -math.inf
        self._last_boot_s = -math.inf
        self.reboots = 0
        self.slips = 0

    def to_monotonic(self, boot_s: float, arrival_s: float) -> float:
        """The instant `boot_s` on our clock, never later than `arrival_s`. A jump back of the boot time is a reboot."""
        if boot_s < self._last_boot_s - REBOOT_JUMP_S:
            self._restart()
        self._last_boot_s = max(self._last_boot_s, boot_s)
        if arrival_s - self._bucket_start_s > BUCKET_S:
            self._previous, self._current, self._bucket_start_s = self._current, math.inf, arrival_s
        self._current = min(self._current, arrival_s - boot_s)
        smallest = min(self._previous, self._current)
        allowed = self._offset + MAX_DRIFT * max(0.0, arrival_s - self._arrival_s)
        self._offset = smallest if math.isinf(self._offset) else min(smallest, allowed)
        self._arrival_s = arrival_s
        return boot_s + self._offset

    def bound(self, boot_s: float, asked_s: float) -> None:
        """The vehicle's clock showed `boot_s` at some instant after `asked_s` on ours (TIMESYNC): the offset cannot be smaller.

        No delay of the link can feign this, since `asked_s` was read here before the question left.
        """
        smallest_possible = asked_s - boot_s
        if self._offset < smallest_possible - SLIP_TOLERANCE_S:
            self.slips += 1
            self._offset = self._current = smallest_possible
            self._previous = math.inf

    def _restart(self) -> None:
        self.reboots += 1
        self._previous = self._current = self._offset = math.inf
        self._bucket_start_s = self._last_boot_s = -math.inf


@dataclass(frozen=True, slots=True)
class LocalPosition:
    """LOCAL_POSITION_NED: estimated position (m) and velocity (m/s)."""

    time_s: float
    position: NedVector
    velocity: NedVector


@dataclass(frozen=True, slots=True)
class Attitude:
    """ATTITUDE: aerospace Euler angles (rad) and body yaw rate (rad/s, clockwise positive)."""

    time_s: float
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    yaw_rate_rad_s: float


@dataclass(frozen=True, slots=True)
class Imu:
    """HIGHRES_IMU: specific force in the body FRD frame, m/s^2 (gravity included: -9.8 on z at rest)."""

    time_s: float
    specific_force: NedVector


@dataclass(frozen=True, slots=True)
class StatusText:
    """A line of text from the autopilot. `severity`: 0 emergency ... 7 debug."""

    time_s: float
    severity: int
    text: str


def acceleration_ned(imu: Imu, attitude: Attitude) -> NedVector:
    """Linear acceleration in NED: specific force turned from body FRD by roll, pitch, yaw (Z-Y-X), gravity added back.

    This is the instant true dv/dt that the policy was trained on, plus the IMU's bias and noise; differences of the
    velocity estimate would lag by half their window.
    """
    force = imu.specific_force
    cr, sr = math.cos(attitude.roll_rad), math.sin(attitude.roll_rad)
    cp, sp = math.cos(attitude.pitch_rad), math.sin(attitude.pitch_rad)
    cy, sy = math.cos(attitude.yaw_rad), math.sin(attitude.yaw_rad)
    level_y = cr * force.y - sr * force.z
    rolled_z = sr * force.y + cr * force.z
    ahead = cp * force.x + sp * rolled_z
    down = -sp * force.x + cp * rolled_z
    return NedVector(cy * ahead - sy * level_y, sy * ahead + cy * level_y, down + GRAVITY_M_S2)


class Telemetry:
    """What the autopilot last said. Fed from MAVSDK's thread, read from the loop's; each sample is replaced as a whole."""

    def __init__(self) -> None:
        self.clock = BootClock()
        self.position: LocalPosition | None = None
        self.attitude: Attitude | None = None
        self.imu: Imu | None = None
        self.heartbeat_s = -math.inf
        self.autopilot: int | None = None
        self.armed: bool | None = None
        self.mode: int | None = None
        self.mode_log: tuple[int, tuple[tuple[float, int], ...]] = (0, ())
        self.landed_state: int | None = None
        self.battery_fraction: float | None = None
        self.report = SelfReport()
        self.texts: deque[StatusText] = deque(maxlen=MAX_TEXTS)
        self.dropped = 0
        self.counts: dict[str, int] = {}
        self._last_boot_s: dict[str, float] = {}
        self._last_time_s: dict[str, float] = {}

    def feed(self, name: str, component: int, fields_json: str, arrival_s: float) -> None:
        """Take one message. Whatever cannot be used is counted in `dropped`, never raised: this runs on MAVSDK's thread."""
        handler = _HANDLERS.get(name)
        if handler is None or component != AUTOPILOT_COMPONENT:
            return
        try:
            handler(self, json.loads(fields_json), arrival_s)
            self.counts[name] = self.counts.get(name, 0) + 1
        except (ValueError, KeyError, TypeError, OverflowError):
            self.dropped += 1

    def state(self, frame: CorridorFrame) -> VehicleState | None:
        """The newest motion in the corridor frame, dated by the oldest of position, attitude and IMU; None before the first."""
        position, attitude, imu = self.position, self.attitude, self.imu
        if position is None or attitude is None or imu is None:
            return None
        return VehicleState(
            time_s=min(position.time_s, attitude.time_s, imu.time_s),
            position=frame.point_to_corridor(position.position),
            velocity=frame.vector_to_corridor(position.velocity),
            acceleration=frame.vector_to_corridor(acceleration_ned(imu, attitude)),
            roll_rad=attitude.roll_rad,
            pitch_rad=attitude.pitch_rad,
            yaw_rad=frame.yaw_to_corridor(attitude.yaw_rad),
            yaw_rate_rad_s=frame.yaw_rate_to_ned(attitude.yaw_rate_rad_s),
            reset_counter=self.report.reset_counter,
        )

    def _sample_time(self, kind: str, boot_s: float, arrival_s: float) -> float:
        """Our time of a sample; a duplicate or one overtaken on the way is refused, so time never runs backwards."""
        reboots = self.clock.reboots
        time_s = self.clock.to_monotonic(boot_s, arrival_s)
        if self.clock.reboots != reboots:
            self._last_boot_s.clear()
            self._last_time_s.clear()
        if boot_s <= self._last_boot_s.get(kind, -math.inf):
            raise ValueError(f"{kind} not newer than the last")
        self._last_boot_s[kind] = boot_s
        # A better estimate of the clock offset may date this sample before the last one: hold the date, never step back.
        self._last_time_s[kind] = max(time_s, self._last_time_s.get(kind, -math.inf))
        return self._last_time_s[kind]

    def _on_position(self, fields: dict[str, object], arrival_s: float) -> None:
        time_s = self._sample_time("position", _number(fields, "time_boot_ms") * 1e-3, arrival_s)
        self.position = LocalPosition(time_s, _vector(fields, "x", "y", "z"), _vector(fields, "vx", "vy", "vz"))

    def _on_attitude(self, fields: dict[str, object], arrival_s: float) -> None:
        time_s = self._sample_time("attitude", _number(fields, "time_boot_ms") * 1e-3, arrival_s)
        angles = (_number(fields, "roll"), _number(fields, "pitch"), _number(fields, "yaw"))
        self.attitude = Attitude(time_s, *angles, _number(fields, "yawspeed"))

    def _on_imu(self, fields: dict[str, object], arrival_s: float) -> None:
        time_s = self._sample_time("imu", _number(fields, "time_usec") * 1e-6, arrival_s)
        self.imu = Imu(time_s, _vector(fields, "xacc", "yacc", "zacc"))

    def _on_timesync(self, fields: dict[str, object], arrival_s: float) -> None:
        """An answer to `VehicleLink.ask_time`; PX4's own questions (tc1 = 0) are MAVSDK's business."""
        boot_s, asked_s = _number(fields, "tc1") * 1e-9, _number(fields, "ts1") * 1e-9
        if boot_s > 0.0 and 0.0 <= arrival_s - asked_s <= MAX_ROUND_TRIP_S:
            self.clock.bound(boot_s, asked_s)
            self.report.round_trip_s = arrival_s - asked_s

    def _on_odometry(self, fields: dict[str, object], _arrival_s: float) -> None:
        self.report.reset_counter = int(_number(fields, "reset_counter"))

    def _on_estimator(self, fields: dict[str, object], _arrival_s: float) -> None:
        self.report.set_estimator(int(_number(fields, "flags")), _number(fields, "pos_horiz_accuracy"))

    def _on_target(self, fields: dict[str, object], arrival_s: float) -> None:
        if fields["vx"] is None:  # JSON has no NaN: no velocity is set
            self.report.echo = None
            return
        time_s = self._sample_time("target", _number(fields, "time_boot_ms") * 1e-3, arrival_s)
        self.report.echo = Echo(time_s, _vector(fields, "vx", "vy", "vz"))

    def _on_heartbeat(self, fields: dict[str, object], arrival_s: float) -> None:
        self.autopilot = int(_number(fields, "autopilot"))
        self.armed = bool(int(_number(fields, "base_mode")) & MODE_FLAG_ARMED)
        self._set_mode(int(_number(fields, "custom_mode")), arrival_s)
        self.heartbeat_s = arrival_s

    def _on_current_mode(self, fields: dict[str, object], arrival_s: float) -> None:
        self._set_mode(int(_number(fields, "custom_mode")), arrival_s)

    def _set_mode(self, custom_mode: int, arrival_s: float) -> None:
        mode = mode_of(custom_mode)
        if mode != self.mode:
            count, kept = self.mode_log
            self.mode_log = (count + 1, (*kept[1 - MAX_MODE_CHANGES :], (arrival_s, mode)))  # one reference: read whole by others
        self.mode = mode

    def _on_landed(self, fields: dict[str, object], _arrival_s: float) -> None:
        self.landed_state = int(_number(fields, "landed_state"))

    def _on_battery(self, fields: dict[str, object], _arrival_s: float) -> None:
        percent = _number(fields, "battery_remaining")
        self.battery_fraction = percent / 100.0 if 0.0 <= percent <= 100.0 else None

    def _on_text(self, fields: dict[str, object], arrival_s: float) -> None:
        text = str(fields["text"]).rstrip("\x00").strip()
        self.texts.append(StatusText(arrival_s, int(_number(fields, "severity")), text[:60]))


_HANDLERS = {
    "LOCAL_POSITION_NED": Telemetry._on_position,
    "ATTITUDE": Telemetry._on_attitude,
    "HIGHRES_IMU": Telemetry._on_imu,
    "TIMESYNC": Telemetry._on_timesync,
    "ODOMETRY": Telemetry._on_odometry,
    "ESTIMATOR_STATUS": Telemetry._on_estimator,
    "POSITION_TARGET_LOCAL_NED": Telemetry._on_target,
    "HEARTBEAT": Telemetry._on_heartbeat,
    "CURRENT_MODE": Telemetry._on_current_mode,
    "EXTENDED_SYS_STATE": Telemetry._on_landed,
    "SYS_STATUS": Telemetry._on_battery,
    "STATUSTEXT": Telemetry._on_text,
}
MESSAGES = tuple(_HANDLERS)


def _number(fields: dict[str, object], key: str) -> float:
    value = fields[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(key)
    return value


def _vector(fields: dict[str, object], x: str, y: str, z: str) -> NedVector:
    return NedVector(_number(fields, x), _number(fields, y), _number(fields, z))
