"""The vehicle at one instant as its own autopilot believes it: what messages and logs are filled from."""

from __future__ import annotations

from dataclasses import dataclass

from sim_gateway.local_frame import Vector

Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """NED and FRD, SI, radians. Motors 0..1."""

    time_s: float
    position: Vector
    velocity: Vector
    attitude: Quaternion  # body FRD to NED, w x y z
    roll_pitch_yaw: Vector
    body_rates: Vector
    specific_force: Vector  # body, gravity included as an accelerometer sees it
    motors: tuple[float, float, float, float]


def rotate_to_body(attitude: Quaternion, vector: Vector) -> Vector:
    """A NED vector in body axes."""
    w, x, y, z = attitude
    a, b, c = vector
    return (
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c,
        2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c,
        2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    )
