"""The client side of PX4's simulator interface, with a simple controller in PX4's place that flies on the ground truth."""

from __future__ import annotations

import math
import socket
from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import development as mav

from sim_gateway.frame_reader import FrameReader, decode
from sim_gateway.mavlink_frame import FramePacker

STARTING_STEPS = 15  # steps that PX4 takes in before its first answer
HOVER = 0.5
_G = 9.80665


def _clip(value: float, most: float) -> float:
    return max(-most, min(most, value))


@dataclass
class Controller:
    """Velocity (NED) to motors, as plainly as it goes: no integrators, no filters."""

    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    armed: bool = False

    def motors(self, truth: Any) -> list[float]:
        if not self.armed:
            return [0.0] * 4
        speed = (truth.vx * 0.01, truth.vy * 0.01, truth.vz * 0.01)
        north, east, down = (_clip(1.8 * (want - now), 4.0) for want, now in zip(self.velocity, speed, strict=True))
        w, x, y, z = truth.attitude_quaternion
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = math.asin(_clip(2 * (w * y - z * x), 1.0))
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        ahead, right = math.cos(yaw) * north + math.sin(yaw) * east, math.cos(yaw) * east - math.sin(yaw) * north
        p = 0.06 * (5.0 * (right / _G - roll) - truth.rollspeed)
        q = 0.06 * (5.0 * (-ahead / _G - pitch) - truth.pitchspeed)
        r = 0.2 * (2.0 * math.remainder(self.yaw - yaw, 2 * math.pi) - truth.yawspeed)
        thrust = HOVER * (1.0 - down / _G) / (math.cos(roll) * math.cos(pitch))
        mixed = (thrust - p + q + r, thrust + p - q + r, thrust + p + q - r, thrust - p - q - r)
        return [max(0.0, min(1.0, value)) for value in mixed]


@dataclass
class Step:
    """What came with one HIL_SENSOR: the messages before it in order, and itself."""

    before: list[Any]
    sensor: Any


@dataclass
class StandIn:
    """Connects like PX4, keeps quiet while it starts, then answers every step once."""

    port: int
    controller: Controller = field(default_factory=Controller)
    answers: int = 0

    def __post_init__(self) -> None:
        self.socket = socket.create_connection(("127.0.0.1", self.port), timeout=30.0)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.reader, self.packer = FrameReader(), FramePacker(1, 1)
        self._before: list[Any] = []
        self._steps: list[Step] = []
        self.truth: Any = None
        self.send(mav.MAVLink_command_long_message(0, 0, 511, 0, 115, 5000, 0, 0, 0, 0, 0))
        self.send(mav.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3))

    def send(self, message: Any) -> None:
        self.socket.sendall(self.packer.pack(message))

    def step(self) -> Step:
        """The next step as it arrives; not answered yet."""
        while not self._steps:
            data = self.socket.recv(8192)
            if not data:
                raise EOFError("the simulator has gone")
            for frame in self.reader.feed(data):
                message = decode(frame)
                if message.get_type() == "HIL_SENSOR":
                    self._steps.append(Step(self._before, message))
                    self._before = []
                else:
                    self._before.append(message)
        step = self._steps.pop(0)
        self.truth = next((m for m in step.before if m.get_type() == "HIL_STATE_QUATERNION"), self.truth)
        return step

    def start(self) -> list[Step]:
        """Take in the first steps without an answer, as PX4 does."""
        return [self.step() for _ in range(STARTING_STEPS)]

    def answer(self, step: Step, motors: list[float] | None = None) -> None:
        values = self.controller.motors(self.truth) if motors is None else motors
        mode = 129 if self.controller.armed else 1
        self.send(mav.MAVLink_hil_actuator_controls_message(step.sensor.time_usec, [*values, *[0.0] * 12], mode, 1))
        self.answers += 1

    def fly(self, seconds: float) -> list[Step]:
        steps = []
        for _ in range(round(seconds / 0.004)):
            steps.append(self.step())
            self.answer(steps[-1])
        return steps

    def close(self) -> None:
        self.socket.close()
