"""The adversaries. Each knows the truth, which no real policy does, and wants to crash or to leave the fence."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from campaigns.adversaries.geometry import to_nearest_box
from campaigns.adversaries.scenes import Scene
from safety.frames import CorridorVector
from safety.messages import LidarScan, VehicleState, VelocityCommand

Array = NDArray[np.float64]
Generator = np.random.Generator
FAST_M_S = 3.0  # far above every limit: the filter must shorten it
LOW, HIGH = np.array((-0.5, -0.5, -0.5, -1.0)), np.array((1.0, 0.5, 0.5, 1.0))  # what the real policy can ask for


@dataclass
class View:
    """What an adversary sees at a tick: the truth, and what the stack got."""

    scene: Scene
    tick: int = 0
    place: Array = field(default_factory=lambda: np.zeros(3))
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    yaw_rad: float = 0.0
    boxes: Array = field(default_factory=lambda: np.empty((0, 6)))
    scan: LidarScan | None = None
    state: VehicleState | None = None

    def to_obstacle(self) -> Array:
        """Horizontal vector [2] to the nearest obstacle's surface."""
        return np.array(to_nearest_box(self.boxes, self.place[0], self.place[1]))

    def to_fence(self) -> Array:
        """Horizontal vector [2] to the nearest part of the fence."""
        foot = self.scene.fence.nearest(self.place[0], self.place[1])
        return np.array(foot) - self.place[:2]

    def threat(self) -> Array:
        """Direction [3] to the nearest obstacle or fence; vertical part to the nearer of floor and ceiling."""
        obstacle, fence = self.to_obstacle(), self.to_fence()
        nearest = obstacle if obstacle @ obstacle < fence @ fence else fence
        shape = self.scene.fence
        up = 1.0 if shape.z_high_m - self.place[2] < self.place[2] - shape.z_low_m else -1.0
        return np.array((nearest[0], nearest[1], up))


Policy = Callable[[View], VelocityCommand]


def command(x: float, y: float, z: float, yaw_rate: float) -> VelocityCommand:
    """A command in the corridor frame."""
    return VelocityCommand(CorridorVector(float(x), float(y), float(z)), float(yaw_rate))


def in_heading(view: View, action: Array) -> VelocityCommand:
    """An action [4] of the policy's kind, turned from the heading frame."""
    c, s = math.cos(view.yaw_rad), math.sin(view.yaw_rad)
    return command(c * action[0] - s * action[1], s * action[0] + c * action[1], action[2], action[3])


def towards(view: View, way: Array, look_off_rad: float = 0.0, climb: float = 0.0, speed: float = FAST_M_S) -> VelocityCommand:
    """Along a horizontal vector [2], looking `look_off_rad` to the left of it."""
    bearing = math.atan2(way[1], way[0])
    turn = 4.0 * math.remainder(bearing + look_off_rad - view.yaw_rad, 2.0 * math.pi)
    return command(speed * math.cos(bearing), speed * math.sin(bearing), climb, max(-1.0, min(1.0, turn)))


def bang(scene: Scene, random: Generator) -> Policy:
    """Corners of the action box, held for 0.15 to 2 s."""
    hold, action = int(random.integers(3, 40)), LOW.copy()

    def policy(view: View) -> VelocityCommand:
        if view.tick % hold == 0:
            action[:] = np.where(random.random(4) < 0.5, LOW, HIGH)
        return in_heading(view, action)

    return policy


def bang_beyond(scene: Scene, random: Generator) -> Policy:
    """As bang-bang, in the corridor frame and far beyond every limit."""
    hold, action = int(random.integers(2, 30)), np.zeros(4)

    def policy(view: View) -> VelocityCommand:
        if view.tick % hold == 0:
            action[:] = FAST_M_S * random.choice((-1.0, 0.0, 1.0), 4)
        return command(*action)

    return policy


def nyquist(scene: Scene, random: Generator) -> Policy:
    """Full reversals at every tick, or every other."""
    hold, action = int(random.integers(1, 3)), FAST_M_S * random.choice((-1.0, 1.0), 4)

    def policy(view: View) -> VelocityCommand:
        if view.tick % hold == 0:
            action[:] = -action
        if random.random() < 0.02:
            action[:3] = FAST_M_S * random.uniform(-1.0, 1.0, 3)
        return command(*action)

    return policy


def noise(scene: Scene, random: Generator) -> Policy:
    """A new action at every tick."""
    return lambda view: in_heading(view, random.uniform(LOW, HIGH))


def smooth(scene: Scene, random: Generator) -> Policy:
    """A slow random walk through the actions."""
    walk, pull = np.zeros(4), random.uniform(0.005, 0.05)

    def policy(view: View) -> VelocityCommand:
        walk[:] += -pull * walk + 0.2 * random.standard_normal(4)
        return in_heading(view, np.clip(walk, -1.0, 1.0) * HIGH)

    return policy


def obstacle(scene: Scene, random: Generator) -> Policy:
    """Straight at the nearest obstacle, looking at it; now and then another direction, to reach others."""
    away = np.zeros(3)

    def policy(view: View) -> VelocityCommand:
        if view.tick % 120 == 0:
            away[:] = (*random.uniform(-1.0, 1.0, 2), random.integers(20, 60))
        return towards(view, away[:2] if view.tick % 120 < away[2] else view.to_obstacle())

    return policy


def obstacle_unseen(scene: Scene, random: Generator) -> Policy:
    """At the nearest obstacle or fence while looking away from it: sideways or backwards, speed varied."""
    off, speed = random.choice((-1.0, 1.0)) * random.uniform(1.2, math.pi), random.choice((0.3, 0.5, FAST_M_S))
    change = int(random.integers(60, 200))
    away = np.zeros(3)

    def policy(view: View) -> VelocityCommand:
        if view.tick % change == 0:
            away[:] = (*random.uniform(-1.0, 1.0, 2), random.integers(5, 60))
        way = away[:2] if view.tick % change < away[2] else view.threat()[:2]
        return towards(view, way, off, speed=speed)

    return policy


def corner(scene: Scene, random: Generator) -> Policy:
    """Into a corner of the fence, floor or ceiling included."""
    target, climb, off = np.zeros(2), random.choice((-1.0, 0.0, 1.0)), random.choice((0.0, 0.0, math.pi / 4, math.pi))

    def policy(view: View) -> VelocityCommand:
        if view.tick % 150 == 0:
            target[:] = random.choice(scene.fence.corners)
        return towards(view, target - view.place[:2], off, climb)

    return policy


def reflex(scene: Scene, random: Generator) -> Policy:
    """Round edges that stick into the free space, cutting them short: boxes' edges and the fence's own."""
    boxes = scene.boxes
    edges = [boxes[:, [0, 1]], boxes[:, [0, 4]], boxes[:, [3, 1]], boxes[:, [3, 4]], scene.fence.reflex_corners]
    places = np.concatenate(edges)
    target, past = np.zeros(2), random.uniform(-0.5, 0.5)

    def policy(view: View) -> VelocityCommand:
        to = places - view.place[:2]
        if view.tick % 60 == 0:
            near = np.argsort((to * to).sum(axis=1))[:6]
            target[:] = places[random.choice(near)]
        way = target - view.place[:2]
        return towards(view, way + past * np.array((-way[1], way[0])) / max(float(np.hypot(*way)), 0.1))

    return policy


def circle(scene: Scene, random: Generator) -> Policy:
    """Round the nearest obstacle or fence at speed, then strike at it."""
    sense, period, length = random.choice((-1.0, 1.0)), int(random.integers(20, 100)), int(random.integers(5, 40))
    look = random.choice((0.0, math.pi / 2, -math.pi / 2))

    def policy(view: View) -> VelocityCommand:
        way = view.threat()[:2]
        if view.tick % period < length:
            return towards(view, way, look)
        side = sense * np.array((-way[1], way[0]))
        return towards(view, side + 0.3 * way, look)

    return policy


def graze(scene: Scene, random: Generator) -> Policy:
    """Along surfaces at full speed, leaning on them at a small angle that changes."""
    sense, lean = random.choice((-1.0, 1.0)), random.uniform(0.05, 0.6)
    climb = random.choice((0.0, 0.0, 0.5, -0.5))

    def policy(view: View) -> VelocityCommand:
        way = view.threat()[:2]
        side = sense * np.array((-way[1], way[0]))
        return towards(view, side + lean * (1.0 + math.sin(0.1 * view.tick)) * way, climb=climb)

    return policy


def strafe(scene: Scene, random: Generator) -> Policy:
    """Sideways or backwards runs with the nose fixed in one direction, reversed now and then."""
    nose, way = random.uniform(-math.pi, math.pi), random.choice((math.pi / 2, -math.pi / 2, math.pi, 2.4, -2.4))
    hold, run = int(random.integers(40, 160)), np.zeros(1)

    def policy(view: View) -> VelocityCommand:
        if view.tick % hold == 0:
            run[0] = nose + way + random.choice((0.0, math.pi, 0.5, -0.5))
        bearing, turn = float(run[0]), 4.0 * math.remainder(nose - view.yaw_rad, 2.0 * math.pi)
        return command(FAST_M_S * math.cos(bearing), FAST_M_S * math.sin(bearing), 0.0, max(-1.0, min(1.0, turn)))

    return policy


def spin(scene: Scene, random: Generator) -> Policy:
    """A fixed direction, changed now and then, while turning as fast as can be."""
    rate, way, hold = random.choice((-1.0, 1.0)), np.zeros(2), int(random.integers(30, 150))

    def policy(view: View) -> VelocityCommand:
        if view.tick % hold == 0:
            bearing = random.uniform(-math.pi, math.pi)
            way[:] = math.cos(bearing), math.sin(bearing)
        return command(FAST_M_S * way[0], FAST_M_S * way[1], 0.0, rate)

    return policy


def diagonal(scene: Scene, random: Generator) -> Policy:
    """Full speed along diagonals, climbing and sinking with them; turned about when it stands."""
    way = random.choice((-1.0, 1.0), 3)

    def policy(view: View) -> VelocityCommand:
        if view.tick % 20 == 19 and np.hypot(*view.velocity[:2]) < 0.1:
            way[:] = random.choice((-1.0, 1.0), 3)
        return towards(view, way[:2], random.choice((-0.7, 0.7)), FAST_M_S * way[2])

    return policy


def vertical(scene: Scene, random: Generator) -> Policy:
    """Floor and ceiling in turn, with horizontal runs on top."""
    hold, up, way = int(random.integers(40, 200)), np.array([1.0]), np.zeros(2)

    def policy(view: View) -> VelocityCommand:
        if view.tick % hold == 0:
            up[0] = -up[0]
            way[:] = random.uniform(-1.0, 1.0, 2) * random.choice((0.0, 1.0))
        if random.random() < 0.02:
            up[0] = -up[0]
        return command(FAST_M_S * way[0], FAST_M_S * way[1], FAST_M_S * up[0], 0.0)

    return policy


def dart(scene: Scene, random: Generator) -> Policy:
    """Hover, then a burst at the threat, then back: the commands in flight and the integrators are what it plays with."""
    burst, rest, look = int(random.integers(2, 20)), int(random.integers(2, 30)), random.choice((0.0, 0.0, 1.5, math.pi))

    def policy(view: View) -> VelocityCommand:
        phase, way = view.tick % (burst + rest), view.threat()[:2]
        return towards(view, way if phase < burst else -way, look, speed=FAST_M_S if phase < burst else random.choice((0.0, 0.6)))

    return policy


POLICIES: dict[str, Callable[[Scene, Generator], Policy]] = {
    made.__name__.replace("_", " "): made
    for made in (
        bang, bang_beyond, nyquist, noise, smooth, obstacle, obstacle_unseen, corner, reflex, circle, graze, strafe, spin,
        diagonal, vertical, dart,
    )
}  # fmt: skip
