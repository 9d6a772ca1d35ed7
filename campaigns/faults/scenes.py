"""The phases of flight as scenes: a place, a fence, and a policy that wants something dangerous to be stopped from.

In every scene the policy asks for motion at every tick, so that a missing reaction is seen at the autopilot as a moving setpoint.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flight.mission import Mission
from policy_export.runner import PolicyRunner
from safety.config import Fence, SafetyConfig
from sim_gateway.scene import World, box_row

HEIGHT_M = 2.0
ENGAGE_S = 1.3  # about where the loop begins, after the start of the handshake
Action = tuple[float, float, float, float]
# unequal walls and a pillar: nothing here looks alike when it is mirrored
_SIDES = (box_row((6.0, 2.3, 2.0), (16.0, 0.2, 4.0)), box_row((6.0, -3.0, 2.0), (16.0, 0.2, 4.0)))
_PILLAR = box_row((5.2, 1.5, 2.0), (0.6, 0.6, 4.0))
_WALL = box_row((8.0, -0.35, 2.0), (0.3, 5.4, 4.0))
_START = (1.0, -0.4, 0.0)


@dataclass(frozen=True, slots=True)
class Scene:
    """`wants`: heading-frame action by time since the loop began. The fault begins within `begins_s` after it (uniform)."""

    name: str
    does: str
    wants: Callable[[float], Action]
    begins_s: tuple[float, float]
    boxes: tuple[list[float], ...]
    fence: tuple[tuple[float, float, float], tuple[float, float, float]] = ((-1.0, -2.9, 0.5), (9.0, 2.2, 4.0))

    @property
    def before_offboard(self) -> bool:
        """Whether the fault begins before the loop: it is felt when the loop begins."""
        return self.begins_s[1] < 0.0

    def world(self, seed: int) -> World:
        """Where it happens; the start varies with the seed."""
        shift = np.random.default_rng([seed, 5]).uniform(-0.15, 0.15, 2)
        start = (_START[0] + float(shift[0]), _START[1] + float(shift[1]), 0.0)
        return World(self.name, seed, 16.0, 5.4, 4.0, np.array(self.boxes), (), start, 0.0, (30.0, -0.5, HEIGHT_M))

    def safety(self, mission: Mission) -> SafetyConfig:
        """The mission's safety limits around this place."""
        return mission.safety.model_copy(update={"fence": Fence(min_m=self.fence[0], max_m=self.fence[1])})

    def begin_s(self, seed: int) -> float:
        """When the fault begins, after the loop's begin."""
        low, high = self.begins_s
        return float(np.random.default_rng([seed, 6]).uniform(low, high))


def _steady(*action: float) -> Callable[[float], Action]:
    return lambda _time_s: (action[0], action[1], action[2], action[3])


def _wander(time_s: float) -> Action:
    return 0.12 * math.cos(0.8 * time_s), 0.12 * math.sin(0.8 * time_s), 0.02 * math.cos(0.5 * time_s), 0.05


_BRAKES_AT_S = 1.8


def _then_creep(time_s: float) -> Action:
    return (1.0, 0.0, 0.0, 0.0) if time_s < _BRAKES_AT_S else (0.1, 0.02, 0.0, 0.02)


_OPEN = (*_SIDES, _PILLAR)
_LIST = (
    Scene("engage", "the fault is there before OFFBOARD; then full ahead", _steady(1.0, 0.0, 0.0, 0.0), (-1.2, -0.4), _OPEN),
    Scene("hover", "moves about at 0.12 m/s", _wander, (1.0, 2.0), _OPEN),
    Scene("wall", "full speed towards a wall", _steady(1.0, 0.0, 0.0, 0.0), (1.6, 2.4), (*_SIDES, _WALL)),
    Scene("yawing", "flies a circle of 0.45 m at 0.9 rad/s", _steady(0.4, 0.0, 0.0, 0.9), (1.5, 2.5), _OPEN),
    Scene("braking", "has just begun to slow down from full speed", _then_creep, (1.85, 2.1), (*_SIDES, _WALL)),
    Scene(
        "corner",
        "flies into a corner of the fence",
        _steady(0.8, 0.4, 0.0, 0.0),
        (1.3, 1.9),
        (*_SIDES, _WALL),
        ((-1.0, -2.6, 0.5), (4.4, 1.2, 4.0)),
    ),
)
SCENES: dict[str, Scene] = {scene.name: scene for scene in _LIST}
FLIGHT_SCENES = tuple(SCENES)


class WishfulPolicy:
    """Stands where the policy runner stands: steps the real network, and then wants what the scene wants.

    `upset(action, time_s)` may change the action, raise, or let time pass: faults of the policy.
    """

    def __init__(self, runner: PolicyRunner, scene: Scene, clock: Callable[[], float]) -> None:
        self.metadata = runner.metadata
        self.begun_s = math.inf
        self.upset: Callable[[NDArray[np.float32], float], NDArray[np.float32]] = lambda action, _time_s: action
        self.extra_norm = 0.0
        self._runner, self._scene, self._clock = runner, scene, clock

    @property
    def step_count(self) -> int:
        """Steps since the last reset."""
        return self._runner.step_count

    @property
    def hidden_norm(self) -> float:
        """Of the recurrent state."""
        return self._runner.hidden_norm + self.extra_norm

    def poison(self) -> None:
        """Put a NaN into the recurrent state."""
        self._runner._states[self._runner._current][0] = np.nan

    def reset(self, reason: str = "offboard_entry") -> None:
        """Zero the recurrent state."""
        self._runner.reset(reason)

    def step(self, observation: NDArray[np.float32], now_s: float | None = None) -> NDArray[np.float32]:
        """What the scene wants now."""
        self._runner.step(observation, now_s)
        self.begun_s = min(self.begun_s, self._clock())
        wanted = np.array(self._scene.wants(self._clock() - self.begun_s), dtype=np.float32)
        return self.upset(wanted, self._clock())
