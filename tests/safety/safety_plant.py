"""A small world for the safety tests: velocity-loop plant, vertical boxes, 2D LiDAR. Shares no code with the houses."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from safety.config import Fence, SafetyConfig
from safety.frames import CorridorVector
from safety.messages import LidarScan, SafeCommand, VehicleState, VelocityCommand

ZERO = CorridorVector(0.0, 0.0, 0.0)
FENCE = Fence(min_m=(-2.0, -6.0, 0.3), max_m=(37.0, 6.0, 4.0))


def config(**changes) -> SafetyConfig:
    return SafetyConfig(**({"fence": FENCE} | changes))


def command(x=0.0, y=0.0, z=0.0, yaw_rate=0.0) -> VelocityCommand:
    return VelocityCommand(CorridorVector(x, y, z), yaw_rate)


def state(x=5.0, y=0.0, z=2.0, v=(0.0, 0.0, 0.0), time_s=0.0, yaw=0.0, yaw_rate=0.0, roll=0.0, pitch=0.0) -> VehicleState:
    return VehicleState(time_s, CorridorVector(x, y, z), CorridorVector(*v), ZERO, roll, pitch, yaw, yaw_rate)


def scan(ranges=None, time_s=0.0, beams=180, fov=math.pi, range_max=4.0, sequence=0) -> LidarScan:
    values = np.full(beams, np.inf, dtype=np.float32) if ranges is None else np.asarray(ranges, dtype=np.float32)
    step = fov / values.shape[0]
    return LidarScan(time_s, values, -fov / 2 + step / 2, step, 0.1, range_max, sequence)


def cast(boxes: np.ndarray, x: float, y: float, bearings: np.ndarray, range_max=4.0) -> np.ndarray:
    """Distances [n] to vertical boxes [m, 4] (x0, y0, x1, y1) along world bearings; inf beyond the range."""
    best = np.full(bearings.shape, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        ux, uy = 1.0 / np.cos(bearings), 1.0 / np.sin(bearings)
        for x0, y0, x1, y1 in boxes:
            ax, bx, ay, by = (x0 - x) * ux, (x1 - x) * ux, (y0 - y) * uy, (y1 - y) * uy
            near = np.maximum(np.minimum(ax, bx), np.minimum(ay, by))
            far = np.minimum(np.maximum(ax, bx), np.maximum(ay, by))
            hit = (far >= near) & (far > 0)
            best = np.where(hit, np.minimum(best, np.maximum(near, 0.0)), best)
    return np.where(best > range_max, np.inf, best)


def gap_m(boxes: np.ndarray, x: float, y: float, radius: float = 0.35) -> float:
    """Distance between the hull at (x, y) and the nearest box."""
    dx = np.maximum(np.maximum(boxes[:, 0] - x, x - boxes[:, 2]), 0.0)
    dy = np.maximum(np.maximum(boxes[:, 1] - y, y - boxes[:, 3]), 0.0)
    return float(np.hypot(dx, dy).min()) - radius if boxes.shape[0] else math.inf


@dataclass
class Plant:
    """Point mass behind a velocity loop: dead time, first-order lag, acceleration limited as a vector."""

    x: float = 5.0
    y: float = 0.0
    z: float = 2.0
    yaw: float = 0.0
    lag_s: float = 0.55
    dead_s: float = 0.2
    acceleration_m_s2: float = 3.0
    boxes: np.ndarray = field(default_factory=lambda: np.empty((0, 4)))
    noise_m: float = 0.0
    position_error: tuple[float, float, float] = (0.0, 0.0, 0.0)
    velocity_error: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0
    time_s: float = 0.0
    beams: int = 180

    def __post_init__(self):
        self.v = np.zeros(3)
        self.yaw_rate = 0.0
        self.random = np.random.default_rng(self.seed)
        self.line = deque([(np.zeros(3), 0.0)] * round(self.dead_s / 0.01))

    def estimate(self) -> VehicleState:
        p = np.array((self.x, self.y, self.z)) + self.position_error
        v = self.v + self.velocity_error
        return VehicleState(self.time_s, CorridorVector(*p), CorridorVector(*v), ZERO, 0.0, 0.0, self.yaw, self.yaw_rate)

    def scan(self) -> LidarScan:
        step = math.pi / self.beams
        bearings = -math.pi / 2 + step * (np.arange(self.beams) + 0.5)
        ranges = cast(self.boxes, self.x, self.y, bearings + self.yaw)
        ranges = ranges + self.noise_m * self.random.standard_normal(self.beams)
        return LidarScan(self.time_s, np.where(ranges < 0.1, 0.0, ranges).astype(np.float32), bearings[0], step, 0.1, 4.0)

    def fly(self, sent: SafeCommand, duration_s: float = 0.05) -> None:
        u = np.array((sent.velocity.x, sent.velocity.y, sent.velocity.z))
        for _ in range(round(duration_s / 0.01)):
            self.line.append((u, sent.yaw_rate_rad_s))
            target, self.yaw_rate = self.line.popleft()
            a = (target - self.v) / self.lag_s
            a *= min(1.0, self.acceleration_m_s2 / max(float(np.linalg.norm(a)), 1e-9))
            self.x, self.y, self.z = np.array((self.x, self.y, self.z)) + self.v * 0.01 + a * 0.00005
            self.v = self.v + a * 0.01
            self.yaw += self.yaw_rate * 0.01
            self.time_s += 0.01

    @property
    def gap(self) -> float:
        return gap_m(self.boxes, self.x, self.y)
