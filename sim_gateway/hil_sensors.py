"""What PX4's simulator interface is told of a vehicle: its sensors at their rates, with noise, from the simulated truth.

PX4 takes no magnetometer and no barometer that shows the same value for long: their noise is part of what makes it fly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from pymavlink.dialects.v20 import development as mav

from sim_gateway.hil_reading import CHANGE, FIELD, FORCE, PLACE, RATE, READING, SPEED, TURN, read_truth
from sim_gateway.local_frame import LocalFrame
from sim_gateway.mavlink_frame import FramePacker, Message
from sim_gateway.motor_dynamics import MotorDynamics
from sim_gateway.simulation import Simulation
from sim_gateway.snapshot import rotate_to_body
from sim_gateway.vehicle import OMEGA, STEP_S
from sim_gateway.vehicle_params import GRAVITY_M_S2

SYSTEM_ID, COMPONENT_ID = 1, 51
FIELD_NED_GAUSS = (0.2107, 0.0130, 0.4320)  # at PX4's usual place
INERTIAL, MAGNETIC, PRESSURE = 0x3F, 0x1C0, 0x1A00  # groups of fields_updated; PX4 uses whole groups only
MAGNETIC_STEPS, PRESSURE_STEPS, GPS_STEPS = 2, 5, 25  # 125, 50 and 10 Hz
_VISION_PER_STEP = 30.0 * STEP_S
_BODY_FRD = 12
_SPEED_LIMIT_CM_S = 32767
_BLOCK_STEPS = 500


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """One sigma of white noise, per sample; as flown with PX4 v1.17."""

    accelerometer_m_s2: float = 0.05
    gyroscope_rad_s: float = 0.002
    magnetometer_gauss: float = 0.002
    barometer_pa: float = 1.0
    gps_horizontal_m: float = 0.1
    gps_vertical_m: float = 0.15
    gps_speed_m_s: float = 0.05
    vision_m: float = 0.02
    vision_rad: float = 0.01
    vision_speed_m_s: float = 0.01


class HilSensors:
    """Sensors of one vehicle. Call `frames` once after every step; equal seeds give equal bytes.

    `gps`: HIL_GPS, else ODOMETRY as from a vision system. `truth`: also HIL_STATE_QUATERNION, which PX4 in SITL logs as ground
    truth. A flight controller in HITL must not get it: it takes the message for its own estimate.
    """

    def __init__(
        self,
        simulation: Simulation,
        dynamics: MotorDynamics,
        frame: LocalFrame,
        seed: int = 0,
        *,
        gps: bool = True,
        truth: bool = True,
        noise: SensorNoise | None = None,
    ) -> None:
        self._simulation, self._dynamics, self._frame = simulation, dynamics, frame
        self._gps, self._truth, self._noise = gps, truth, noise or SensorNoise()
        heading = frame.heading_rad
        turned = (math.cos(heading), math.sin(heading), math.cos(0.5 * heading), math.sin(0.5 * heading))
        self._axes = np.array([*frame.origin, *turned])
        self._field = np.array(FIELD_NED_GAUSS)
        self._out = np.empty(READING)
        self._generator = np.random.Generator(np.random.PCG64([seed, 4]))
        self._draw = self._normals()
        self._packer = FramePacker(SYSTEM_ID, COMPONENT_ID)

    def _normals(self) -> Callable[[], float]:
        """Standard normal numbers, one by one, drawn in blocks."""

        def endless() -> Iterator[float]:
            while True:
                yield from self._generator.standard_normal(10 * _BLOCK_STEPS).tolist()

        numbers = endless()
        return lambda: next(numbers)

    def frames(self) -> bytes:
        """Everything that is due after this step, packed; HIL_SENSOR last, because it lets PX4 go on."""
        steps, state = self._simulation.steps, self._simulation.state_row
        time_us = round(steps * STEP_S * 1e6)
        force, rate = self._dynamics.specific_force_m_s2, self._dynamics.rate_rad_s
        read_truth(state, force, rate, self._field, self._axes, self._out)
        reading = self._out.tolist()
        messages: list[Message] = []
        if self._gps and steps % GPS_STEPS == 0 and self._simulation.faults.active("gps_loss", self._simulation.time_s) is None:
            messages.append(self._gps_message(time_us, reading))
        if not self._gps and math.floor(steps * _VISION_PER_STEP) > math.floor((steps - 1) * _VISION_PER_STEP):
            messages.append(self._vision_message(time_us, reading))
        if self._truth:
            messages.append(self._truth_message(time_us, reading, state[OMEGA : OMEGA + 3].tolist()))
        messages.append(self._sensor_message(steps, time_us, reading))
        return b"".join(map(self._packer.pack, messages))

    def heartbeat(self) -> bytes:
        """A simulator's heartbeat, packed: what makes a flight controller take a serial line for a MAVLink link."""
        beat = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GENERIC, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE, 3)
        return self._packer.pack(beat)

    def _sensor_message(self, steps: int, time_us: int, reading: list[float]) -> Message:
        noise, draw = self._noise, self._draw
        updated = INERTIAL | (steps % MAGNETIC_STEPS == 0) * MAGNETIC | (steps % PRESSURE_STEPS == 0) * PRESSURE
        force = [value + noise.accelerometer_m_s2 * draw() for value in reading[FORCE:RATE]]
        rate = [value + noise.gyroscope_rad_s * draw() for value in reading[RATE:FIELD]]
        field = [value + noise.magnetometer_gauss * draw() for value in reading[FIELD:PLACE]]
        altitude_m = self._frame.altitude_m - reading[PLACE + 2]
        pressure = pressure_pa(altitude_m) + noise.barometer_pa * draw()
        return mav.MAVLink_hil_sensor_message(time_us, *force, *rate, *field, 0.01 * pressure, 0.0, altitude_m, 20.0, updated)

    def _gps_message(self, time_us: int, reading: list[float]) -> Message:
        noise, draw = self._noise, self._draw
        sigmas = (noise.gps_horizontal_m, noise.gps_horizontal_m, noise.gps_vertical_m)
        north, east, down = (value + sigma * draw() for value, sigma in zip(reading[PLACE:SPEED], sigmas, strict=True))
        latitude, longitude, altitude = self._frame.to_global((north, east, down))
        vn, ve, vd = (_cm_s(value + noise.gps_speed_m_s * draw()) for value in reading[SPEED:TURN])
        course = round(100.0 * math.degrees(math.atan2(ve, vn))) % 36000
        place = (round(1e7 * latitude), round(1e7 * longitude), round(1e3 * altitude))
        return mav.MAVLink_hil_gps_message(time_us, 3, *place, 30, 40, round(math.hypot(vn, ve)), vn, ve, vd, course, 12)

    def _truth_message(self, time_us: int, reading: list[float], rate: list[float]) -> Message:
        north, east, down = reading[PLACE:SPEED]
        latitude, longitude, altitude = self._frame.to_global((north, east, down))
        speed = [_cm_s(value) for value in reading[SPEED:TURN]]
        change = [_int16(1e3 * value / GRAVITY_M_S2) for value in reading[CHANGE:READING]]
        air = min(_SPEED_LIMIT_CM_S, round(math.hypot(*speed)))
        place = (round(1e7 * latitude), round(1e7 * longitude), round(1e3 * altitude))
        p, q, r = rate
        return mav.MAVLink_hil_state_quaternion_message(
            time_us, reading[TURN:CHANGE], p, -q, -r, *place, *speed, air, air, *change
        )

    def _vision_message(self, time_us: int, reading: list[float]) -> Message:
        noise, draw = self._noise, self._draw
        place = [value + noise.vision_m * draw() for value in reading[PLACE:SPEED]]
        turn = _disturbed(reading[TURN:CHANGE], [noise.vision_rad * draw() for _ in range(3)])
        (w, x, y, z), (north, east, down) = reading[TURN:CHANGE], reading[SPEED:TURN]
        speed = [v + noise.vision_speed_m_s * draw() for v in rotate_to_body((w, x, y, z), (north, east, down))]
        return mav.MAVLink_odometry_message(
            *(time_us, mav.MAV_FRAME_LOCAL_NED, _BODY_FRD, *place, turn, *speed, *reading[RATE:FIELD]),
            *(_covariance(noise.vision_m, noise.vision_rad), _covariance(noise.vision_speed_m_s, noise.vision_rad)),
            *(0, mav.MAV_ESTIMATOR_TYPE_VIO, 90),
        )


def pressure_pa(altitude_m: float) -> float:
    """Air pressure of the standard atmosphere at an altitude above mean sea level (ICAO, troposphere)."""
    return 101325.0 * math.pow(1.0 - 0.0065 * altitude_m / 288.15, 5.25588)


def _covariance(linear: float, angular: float) -> list[float]:
    """Upper triangle of a 6 x 6 covariance with these sigmas on its diagonal."""
    values = [0.0] * 21
    for index in (0, 6, 11):
        values[index] = linear * linear
    for index in (15, 18, 20):
        values[index] = angular * angular
    return values


def _disturbed(turn: list[float], angles: list[float]) -> list[float]:
    """A quaternion turned by small angles about the body's axes."""
    w, x, y, z = turn
    a, b, c = (0.5 * angle for angle in angles)
    turned = [w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c, z + w * c + x * b - y * a]
    size = math.sqrt(sum(value * value for value in turned))
    return [value / size for value in turned]


def _cm_s(speed_m_s: float) -> int:
    return _int16(100.0 * speed_m_s)


def _int16(value: float) -> int:
    return max(-32768, min(32767, round(value)))
