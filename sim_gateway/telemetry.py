"""Telemetry: how each MAVLink message is filled from the vehicle. How often it is sent: `stream_rates`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pymavlink.dialects.v20 import development as mav

from sim_gateway import census_messages as more
from sim_gateway.autopilot import Autopilot
from sim_gateway.flight_modes import FlightMode
from sim_gateway.local_frame import LocalFrame, Vector
from sim_gateway.newer_messages import NEWER_IDS
from sim_gateway.obstacle_distance import obstacle_distance
from sim_gateway.readings import Scan
from sim_gateway.setpoints import OffboardSetpoint
from sim_gateway.snapshot import Snapshot, rotate_to_body
from sim_gateway.stream_rates import FROM_S, LOCAL_FROM_S, POSITION_FLAG_FROM_S, STREAM_RATES_HZ

if TYPE_CHECKING:
    from sim_gateway.report_faults import ReportFaults

Message = Any  # pymavlink publishes no types
SYSTEM_ID, COMPONENT_ID = 1, 1

_SENSORS = 0x1 | 0x2 | 0x4 | 0x8  # gyro, accelerometer, magnetometer, barometer
_CONTROLS = 0x400 | 0x800 | 0x1000 | 0x2000 | 0x4000 | 0x8000
_GPS, _AHRS, _BATTERY, _PREARM = 0x20, 0x200000, 0x2000000, 0x10000000
_POSITION_FLAGS = 2 | 8 | 16  # of ESTIMATOR_STATUS: horizontal velocity, relative and absolute position
_TERRAIN_FLAG, _PREDICTED_FLAGS = 64, 256 | 512
_MAGNETIC_FIELD_NED_GAUSS: Vector = (0.212, 0.009, 0.427)  # at PX4's default place
_EPOCH_US = int(time.time() * 1e6)


def _heading_deg(yaw_rad: float) -> float:
    return math.degrees(yaw_rad) % 360.0


def _clamp_int(value: float, low: int, high: int) -> int:
    return int(min(max(value, low), high))


class Telemetry:
    """Builds messages for the vehicle's present state. `snapshot` is called once per message, `now_s` gives vehicle time.

    `scan`: the newest scan, set by who has the LiDAR; OBSTACLE_DISTANCE tells of it.
    Fault switches: messages named in `silent` are not streamed, and `alter[name]` may change a message before it is sent;
    `faults` are those of the schedule. `booted_s`: vehicle time of the last start, from which its messages count.
    """

    def __init__(
        self,
        autopilot: Autopilot,
        frame: LocalFrame,
        snapshot: Callable[[], Snapshot],
        now_s: Callable[[], float],
        system_id: int = SYSTEM_ID,
    ) -> None:
        self.now_s, self.system_id = now_s, system_id
        self._autopilot = autopilot
        self._frame = frame
        self._snapshot = snapshot
        self._sequence = 0
        self.booted_s = 0.0
        self.faults: ReportFaults | None = None
        self.scan: Scan | None = None
        self.silent: set[str] = set()
        self.alter: dict[str, Callable[[Message], None]] = {}
        self._builders: dict[str, Callable[[Snapshot], Message]] = {
            name: getattr(self, f"_{name.lower()}") for name in (*STREAM_RATES_HZ, "AUTOPILOT_VERSION")
        }
        self._names = {getattr(mav, f"MAVLINK_MSG_ID_{name}", NEWER_IDS.get(name)): name for name in self._builders}

    def name_of(self, message_id: int) -> str | None:
        """The message's name if this vehicle can send it."""
        return self._names.get(message_id)

    def available(self, name: str) -> bool:
        """Whether start-up has come far enough for this message, and what it tells of is there."""
        if name in self.silent or (name == "OBSTACLE_DISTANCE" and self.scan is None):
            return False
        if name == "POSITION_TARGET_GLOBAL_INT" and not all(map(math.isfinite, self._autopilot.target.position)):
            return False
        if self.faults is not None and self.faults.silences(name, self.now_s()):
            return False
        return self.now_s() - self.booted_s >= FROM_S.get(name, LOCAL_FROM_S)

    def boot_s(self) -> float:
        """The vehicle's own clock: time since its last start."""
        return self.now_s() - self.booted_s

    def build(self, name: str) -> Message:
        """The message now; raises KeyError for a name outside the tables."""
        now = self._snapshot()
        if self.faults is not None:
            now = self.faults.snapshot(name, now)
        if self.booted_s or now.time_s < 0.0:
            now = replace(now, time_s=max(0.0, now.time_s - self.booted_s))
        message = self._builders[name](now)
        if self.faults is not None:
            self.faults.alter(name, message, self.now_s())
        if name in self.alter:
            self.alter[name](message)
        return message

    # ---- identity and status

    def _heartbeat(self, _: Snapshot) -> Message:
        pilot = self._autopilot
        return mav.MAVLink_heartbeat_message(
            mav.MAV_TYPE_QUADROTOR,
            mav.MAV_AUTOPILOT_PX4,
            pilot.mode.base_mode(pilot.armed),
            pilot.mode.custom_mode,
            int(pilot.system_status),
            3,
        )

    def _current_mode(self, _: Snapshot) -> Message:
        pilot = self._autopilot
        return mav.MAVLink_current_mode_message(pilot.mode.standard_mode, pilot.mode.custom_mode, pilot.intended.custom_mode)

    def _extended_sys_state(self, _: Snapshot) -> Message:
        return mav.MAVLink_extended_sys_state_message(mav.MAV_VTOL_STATE_UNDEFINED, int(self._autopilot.landed_state))

    def _sys_status(self, _: Snapshot) -> Message:
        present = _SENSORS | _CONTROLS | _GPS | _AHRS | _BATTERY | _PREARM
        health = _SENSORS | _CONTROLS | _BATTERY
        health |= _GPS | _AHRS if self._autopilot.healthy else 0
        health |= _PREARM if self._autopilot.can_arm or self._autopilot.armed else 0
        battery = self._autopilot.battery
        millivolts = round(1000 * battery.volts)
        return mav.MAVLink_sys_status_message(present, present, health, 300, millivolts, 0, battery.percent, 0, 0, 0, 0, 0, 0)

    def _battery_status(self, _: Snapshot) -> Message:
        battery = self._autopilot.battery
        cells = [round(250 * battery.volts)] * 4 + [65535] * 6
        return mav.MAVLink_battery_status_message(0, 0, 0, 32767, cells, 0, 0, -1, battery.percent, 0, battery.charge_state)

    def _estimator_status(self, now: Snapshot) -> Message:
        failsafes = self._autopilot.failsafes
        flags = 0x33F if now.time_s >= POSITION_FLAG_FROM_S else 0x27
        flags |= _TERRAIN_FLAG if not self._autopilot.landed else 0
        flags &= ~_POSITION_FLAGS if failsafes.position_given_up else ~0
        flags &= ~_PREDICTED_FLAGS if failsafes.prediction_given_up else ~0
        return mav.MAVLink_estimator_status_message(self._usec(now), flags, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0, 0.3, 0.4)

    def _autopilot_version(self, _: Snapshot) -> Message:
        zeros = [0] * 8
        return mav.MAVLink_autopilot_version_message(59647, 17891328, 17891328, 0, 1, zeros, zeros, zeros, 0, 0, self.system_id)

    def _mission_current(self, _: Snapshot) -> Message:
        mission, flying = self._autopilot.mission, self._autopilot.mode is FlightMode.MISSION
        state = mav.MISSION_STATE_NO_MISSION if not mission.legs else mav.MISSION_STATE_NOT_STARTED
        if mission.complete:
            state = mav.MISSION_STATE_COMPLETE
        elif flying and mission.legs:
            state = mav.MISSION_STATE_ACTIVE
        elif mission.current:
            state = mav.MISSION_STATE_PAUSED
        number = min(mission.current, max(len(mission.legs) - 1, 0))
        return mav.MAVLink_mission_current_message(number, len(mission.legs), state, 1 if flying else 2 if mission.legs else 0)

    # ---- time

    @staticmethod
    def _usec(now: Snapshot) -> int:
        return round(now.time_s * 1e6)

    @staticmethod
    def _msec(now: Snapshot) -> int:
        return round(now.time_s * 1e3) & 0xFFFFFFFF

    def _system_time(self, now: Snapshot) -> Message:
        return mav.MAVLink_system_time_message(_EPOCH_US + self._usec(now), self._msec(now))

    def _timesync(self, now: Snapshot) -> Message:
        return mav.MAVLink_timesync_message(0, self._usec(now) * 1000)

    def _ping(self, now: Snapshot) -> Message:
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        return mav.MAVLink_ping_message(self._usec(now), self._sequence, 0, 0)

    # ---- motion

    def _attitude(self, now: Snapshot) -> Message:
        return mav.MAVLink_attitude_message(self._msec(now), *now.roll_pitch_yaw, *now.body_rates)

    def _attitude_quaternion(self, now: Snapshot) -> Message:
        return mav.MAVLink_attitude_quaternion_message(self._msec(now), *now.attitude, *now.body_rates)

    def _attitude_target(self, now: Snapshot) -> Message:
        thrust = sum(now.motors) / 4.0
        return mav.MAVLink_attitude_target_message(self._msec(now), 0, list(now.attitude), *now.body_rates, thrust)

    def _local_position_ned(self, now: Snapshot) -> Message:
        return mav.MAVLink_local_position_ned_message(self._msec(now), *now.position, *now.velocity)

    def _odometry(self, now: Snapshot) -> Message:
        unknown = [math.nan] * 21
        return mav.MAVLink_odometry_message(
            self._usec(now),
            mav.MAV_FRAME_LOCAL_NED,
            mav.MAV_FRAME_BODY_FRD,
            *now.position,
            list(now.attitude),
            *rotate_to_body(now.attitude, now.velocity),
            *now.body_rates,
            unknown,
            unknown,
            0,
            mav.MAV_ESTIMATOR_TYPE_AUTOPILOT,
            100,
        )

    def _global_position_int(self, now: Snapshot) -> Message:
        latitude, longitude, altitude = self._frame.to_global(now.position)
        home_down = self._autopilot.home[2]
        speeds = [_clamp_int(v * 100, -32767, 32767) for v in now.velocity]
        return mav.MAVLink_global_position_int_message(
            self._msec(now),
            round(latitude * 1e7),
            round(longitude * 1e7),
            round(altitude * 1e3),
            round((home_down - now.position[2]) * 1e3),
            *speeds,
            round(_heading_deg(now.roll_pitch_yaw[2]) * 100) % 36000,
        )

    def _position_target_local_ned(self, now: Snapshot) -> Message:
        target: OffboardSetpoint = self._autopilot.target
        type_mask = 0 if math.isfinite(target.position[2]) else 7
        type_mask |= 0 if any(math.isfinite(value) for value in target.velocity) else 56
        return mav.MAVLink_position_target_local_ned_message(
            self._msec(now),
            mav.MAV_FRAME_LOCAL_NED,
            type_mask,
            *target.position,
            *target.velocity,
            *target.acceleration,
            target.yaw_rad,
            target.yaw_rate_rad_s,
        )

    def _altitude(self, now: Snapshot) -> Message:
        up = -now.position[2]
        above_home = self._autopilot.home[2] - now.position[2]
        return mav.MAVLink_altitude_message(
            self._usec(now), self._frame.altitude_m + up, self._frame.altitude_m + up, up, above_home, math.nan, max(up, 0.0)
        )

    def _vfr_hud(self, now: Snapshot) -> Message:
        north, east, down = now.velocity
        speed = math.hypot(north, east)
        throttle = _clamp_int(100 * sum(now.motors) / 4.0, 0, 100)
        heading = int(_heading_deg(now.roll_pitch_yaw[2]))
        return mav.MAVLink_vfr_hud_message(speed, speed, heading, throttle, self._frame.altitude_m - now.position[2], -down)

    def _distance_sensor(self, now: Snapshot) -> Message:
        centimetres = _clamp_int(-100.0 * now.position[2], 0, 10000)
        return mav.MAVLink_distance_sensor_message(self._msec(now), 0, 10000, centimetres, 0, 0, 25, 0)

    # ---- sensors

    def _obstacle_distance(self, _: Snapshot) -> Message:
        assert self.scan is not None  # see available
        return obstacle_distance(self.scan)

    def _gps_raw_int(self, now: Snapshot) -> Message:
        latitude, longitude, altitude = self._frame.to_global(now.position)
        speed = math.hypot(now.velocity[0], now.velocity[1])
        course = round(_heading_deg(math.atan2(now.velocity[1], now.velocity[0])) * 100) % 36000
        place = (round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3))
        fix, satellites = (
            (3, int(self._autopilot.parameters.get("SIM_GPS_USED"))) if self._autopilot.failsafes.gps_fix else (0, 0)
        )
        return mav.MAVLink_gps_raw_int_message(
            self._usec(now), fix, *place, 90, 90, _clamp_int(speed * 100, 0, 65534), course, satellites, place[2], 900, 1780, 250
        )

    def _gps_global_origin(self, now: Snapshot) -> Message:
        frame = self._frame
        place = (round(frame.latitude_deg * 1e7), round(frame.longitude_deg * 1e7), round(frame.altitude_m * 1e3))
        return mav.MAVLink_gps_global_origin_message(*place, self._usec(now))

    def _home_position(self, now: Snapshot) -> Message:
        home = self._autopilot.home
        latitude, longitude, altitude = self._frame.to_global(home)
        place = (round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3))
        return mav.MAVLink_home_position_message(*place, *home, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, self._usec(now))

    def _highres_imu(self, now: Snapshot) -> Message:
        field = rotate_to_body(now.attitude, _MAGNETIC_FIELD_NED_GAUSS)
        pressure_hpa = self._pressure_hpa(now)
        altitude = self._frame.altitude_m - now.position[2]
        return mav.MAVLink_highres_imu_message(
            self._usec(now), *now.specific_force, *now.body_rates, *field, pressure_hpa, 0.0, altitude, 15.0, 0x1FFF, 0
        )

    def _pressure_hpa(self, now: Snapshot) -> float:
        """ISA barometric formula below 11 km."""
        altitude = self._frame.altitude_m - now.position[2]
        return float(1013.25 * max(1.0 - 2.25577e-5 * altitude, 0.01) ** 5.25588)

    def _scaled_pressure(self, now: Snapshot) -> Message:
        return mav.MAVLink_scaled_pressure_message(self._msec(now), self._pressure_hpa(now), 0.0, 1500)

    def _servo_output_raw(self, now: Snapshot) -> Message:
        pulses = [1000 + _clamp_int(1000 * motor, 0, 1000) for motor in now.motors] if self._autopilot.armed else [900] * 4
        return mav.MAVLink_servo_output_raw_message(self._usec(now) & 0xFFFFFFFF, 0, *pulses, 0, 0, 0, 0)

    def _vibration(self, now: Snapshot) -> Message:
        return mav.MAVLink_vibration_message(self._usec(now), 0.0, 0.0, 0.0, 0, 0, 0)

    # ---- beside the flight data

    def _current_event_sequence(self, _: Snapshot) -> Message:
        return more.current_event_sequence()

    def _link_node_status(self, now: Snapshot) -> Message:
        return more.link_node_status(self._usec(now))

    def _time_estimate_to_target(self, _: Snapshot) -> Message:
        return more.time_estimate_to_target()

    def _gnss_integrity(self, _: Snapshot) -> Message:
        return more.gnss_integrity()

    def _open_drone_id_location(self, now: Snapshot) -> Message:
        return more.open_drone_id_location(self._autopilot, self._frame, now.position, now.velocity)

    def _open_drone_id_system(self, _: Snapshot) -> Message:
        return more.open_drone_id_system(self._autopilot, self._frame)

    def _position_target_global_int(self, now: Snapshot) -> Message:
        return more.position_target_global_int(self._msec(now), self._autopilot, self._frame)
