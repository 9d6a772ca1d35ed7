"""The six-degree-of-freedom vehicle under the filter, in lockstep."""

from __future__ import annotations

import math

import numpy as np

from safety.config import Fence, SafetyConfig
from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.messages import LidarScan, VehicleState
from sim_gateway.scene import World
from sim_gateway.simulation import Simulation, step_at

FENCE = Fence(min_m=(-0.5, -4.0, 0.3), max_m=(35.5, 4.0, 4.0))


def state_of(motion) -> VehicleState:
    p, v, a = (CorridorVector(*part) for part in (motion.position_m, motion.velocity_m_s, motion.acceleration_m_s2))
    rate = motion.angular_rate_rad_s[2]
    return VehicleState(motion.time_s, p, v, a, motion.roll_rad, motion.pitch_rad, motion.yaw_rad, rate)


def scan_of(scan) -> LidarScan:
    angles = (scan.angle_min_rad, scan.angle_increment_rad)
    return LidarScan(scan.time_s, scan.ranges_m, *angles, scan.range_min_m, scan.range_max_m)


def empty_world() -> World:
    far = np.array([[900.0, 900.0, 0.0, 901.0, 901.0, 1.0]])
    return World(
        name="empty", seed=0, length_m=100.0, width_m=100.0, height_m=20.0, static_boxes=far, movers=(),
        start=(0.0, 0.0, 0.0), start_yaw_rad=0.0, goal=(50.0, 0.0, 2.0),
    )  # fmt: skip


class Flight:
    """Flies a policy (tick, simulation) -> VelocityCommand through the filter and keeps what happened."""

    def __init__(self, policy, simulation: Simulation, ticks: int, config: SafetyConfig | None = None):
        safety, self.simulation = SafetyFilter(config or SafetyConfig(fence=FENCE)), simulation
        self.out, self.faults, self.speed = -math.inf, set(), 0.0
        begin = simulation.steps
        low, high = safety.config.fence.min_m, safety.config.fence.max_m
        for k in range(ticks):
            wanted = policy(k, simulation)
            now = simulation.time_s
            sent, verdict = safety.apply(wanted, state_of(simulation.estimate()), scan_of(simulation.scan()), now)
            self.faults.add(verdict.fault)
            velocity = (sent.velocity.x, sent.velocity.y, sent.velocity.z)
            simulation.advance(begin + step_at((k + 1) * 0.05) - simulation.steps, velocity, sent.yaw_rate_rad_s)
            place, hull = simulation.truth.position_m, (0.35, 0.35, 0.1)
            self.out = max(self.out, *(max(low[i] + hull[i] - place[i], place[i] + hull[i] - high[i]) for i in range(3)))
            self.speed = max(self.speed, math.hypot(sent.velocity.x, sent.velocity.y))
