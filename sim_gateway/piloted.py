"""A simulated vehicle with its autopilot: the part shared by the real-time gateway and by lockstep runs in process."""

from __future__ import annotations

import math

from sim_gateway.autopilot import CONTROL_PERIOD_S, Autopilot
from sim_gateway.autopilot_output import MOTORS_OFF, ControlOutput
from sim_gateway.local_frame import LocalFrame, NedState, Vector
from sim_gateway.parameters import ParameterStore
from sim_gateway.readings import Motion
from sim_gateway.simulation import Simulation
from sim_gateway.snapshot import Quaternion, Snapshot, rotate_to_body
from sim_gateway.vehicle import MOTOR, STEP_S

CONTROL_STEPS = round(CONTROL_PERIOD_S / STEP_S)
_GRAVITY_M_S2 = 9.80665


def _quaternion_ned(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """Aerospace angles (yaw, pitch, roll order) to the quaternion body FRD -> NED."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


class PilotedVehicle:
    """`Simulation` and `Autopilot` joined: the autopilot decides every 20 ms on the estimate, physics run at 4 ms.

    The local NED origin is where the simulation has the vehicle when this is made, on the ground below it.
    """

    def __init__(
        self,
        simulation: Simulation,
        parameters: ParameterStore | None = None,
        *,
        heading_rad: float = 0.0,
        ready_after_s: float | None = None,
    ) -> None:
        self.simulation = simulation
        start = simulation.truth.position_m
        self.frame = LocalFrame((start[0], start[1], 0.0), heading_rad)
        ready = {} if ready_after_s is None else {"ready_after_s": ready_after_s}
        self.autopilot = Autopilot(parameters, altitude_amsl_m=self.frame.altitude_m, **ready)
        self._output = MOTORS_OFF
        self._until_control = 0
        self._snapshot: Snapshot | None = None

    @property
    def time_s(self) -> float:
        """Vehicle time."""
        return self.simulation.time_s

    def advance(self, n_steps: int) -> None:
        """Let `n_steps` of 4 ms pass, with the autopilot in the loop. The result does not depend on how steps are grouped."""
        while n_steps > 0:
            if self._until_control == 0:
                self._output = self.autopilot.step(self.ned_state())
                self._until_control = CONTROL_STEPS
            taken = min(n_steps, self._until_control)
            self._fly(taken, self._output)
            self._until_control -= taken
            n_steps -= taken
        self._snapshot = None

    def _fly(self, n_steps: int, output: ControlOutput) -> None:
        if output.thrust is not None:
            thrust = output.thrust
            share = thrust.share * self.simulation.hover_thrust if thrust.of_hover else thrust.share
            up = self.frame.vector_to_world(thrust.direction)
            self.simulation.advance_thrust(n_steps, up, share, -output.yaw_rate_rad_s)
        elif output.motors_on:
            self.simulation.advance(n_steps, self.frame.vector_to_world(output.velocity), -output.yaw_rate_rad_s)
        else:
            self.simulation.advance_motors_off(n_steps)

    def ned_state(self) -> NedState:
        """The estimate as the autopilot takes it."""
        motion, frame = self.simulation.estimate(acceleration_noise=False), self.frame
        return NedState(
            motion.time_s,
            frame.point_to_ned(motion.position_m),
            frame.vector_to_ned(motion.velocity_m_s),
            frame.yaw_to_ned(motion.yaw_rad),
            self.simulation.landed,
        )

    def snapshot(self) -> Snapshot:
        """The estimate as telemetry reports it; computed once per step."""
        if self._snapshot is None:
            self._snapshot = self._take_snapshot(self.simulation.estimate())
        return self._snapshot

    def _take_snapshot(self, motion: Motion) -> Snapshot:
        frame = self.frame
        yaw = frame.yaw_to_ned(motion.yaw_rad)
        attitude = _quaternion_ned(motion.roll_rad, motion.pitch_rad, yaw)
        north, east, down = frame.vector_to_ned(motion.acceleration_m_s2)
        specific: Vector = rotate_to_body(attitude, (north, east, down - _GRAVITY_M_S2))
        p, q, r = motion.angular_rate_rad_s
        motors = self.simulation.state_row[MOTOR : MOTOR + 4]
        return Snapshot(
            motion.time_s,
            frame.point_to_ned(motion.position_m),
            frame.vector_to_ned(motion.velocity_m_s),
            attitude,
            (motion.roll_rad, motion.pitch_rad, yaw),
            (p, -q, -r),
            specific,
            (float(motors[0]), float(motors[1]), float(motors[2]), float(motors[3])),
        )
