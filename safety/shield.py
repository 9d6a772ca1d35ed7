"""Fence and obstacles together: the nearest command whose brake tube stays inside one and clear of the other.

A command passes when its brake tube (safety.braking) keeps what braking itself would keep (safety.allowance). If the wanted one
does not pass, a fixed number of scaled, turned and projected ones are tried; if none passes, zero velocity is sent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safety.allowance import EPSILON_M, Allowance, allowance, held_in
from safety.braking import Start, Tubes, slow_after_s, tubes
from safety.config import SafetyConfig
from safety.fence_tube import FenceGuard, NearFence, Room, WaysOut
from safety.frames import CorridorVector
from safety.messages import Intervention
from safety.open_space import TubeBox, climb_room_m, kept_to_points_m
from safety.sight import Hidden, Sight, View

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.intp]
SCALES = (0.8, 0.6, 0.4, 0.2, 0.1, 0.05)
TURNS_RAD = tuple(math.radians(angle) for angle in (15.0, 30.0, 45.0, 60.0, 75.0, 85.0))
PUSHES = (1.0, 1.5)  # candidates are shifted by these multiples of what leads out of a margin
FIRST_LOOK = 8  # candidates nearest to the wanted command, judged before all others: one of them usually passes
WAY_SHARES = np.array([[1.0], [0.75], [0.5], [0.25], [0.0]])  # of the way out, for the limits: zero keeps to all of them
OUTWARD = (0.0, 0.1)  # slid candidates: this share of the wanted speed away from the obstacle


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What the shield knows this tick: obstacle points [k] with extra radius, space seen free, place, start of control."""

    x_m: Floats
    y_m: Floats
    extra_m: Floats
    view: View
    position: CorridorVector
    start: Start


@dataclass(frozen=True, slots=True)
class Bounds:
    """What braking sets for all commands of a tick: clearances and speeds, the unseen space on its way, its tube, and the ways
    out of the fence's margins where it comes into any."""

    allowed: Allowance
    hidden: Hidden
    brake: Tubes
    ways: WaysOut | None


@dataclass(frozen=True, slots=True)
class Decision:
    """The chosen velocity, and why it is not the wanted one. `clearance_m`: now, hull to nearest known point."""

    velocity: CorridorVector
    interventions: tuple[Intervention, ...]
    clearance_m: float
    fence_margin_m: float


class Shield:
    """Chooses among the wanted command and a fixed number of scaled, turned and projected ones."""

    def __init__(self, config: SafetyConfig) -> None:
        self._config = config
        self._sight = Sight(config)
        self._guard = FenceGuard(config.eroded_fence(), *config.keep_in_z())
        directions = [(scale, 0.0) for scale in SCALES]
        directions += [(math.cos(turn), sign * turn) for turn in TURNS_RAD for sign in (1, -1)]
        self._scaled = np.array([(scale * math.cos(turn), scale * math.sin(turn)) for scale, turn in directions])

    def choose(self, wanted: CorridorVector, around: Surroundings, within_limits: Callable[[Floats], Booleans]) -> Decision:
        """The wanted velocity itself when it is safe (same object), else the nearest safe candidate, else zero.

        `within_limits`: which of some candidates [c, 3] may be sent at all after the command sent last.
        """
        room, clearance = self._guard.here(around.position), self._clearance_now(around)
        if self._in_the_open(wanted, around, room):
            return Decision(wanted, (), clearance, room.least_m)
        reach = self._reach_m(around.start)
        near = self._guard.look(around.position, around.start, reach)
        fence_margin, around = room.least_m, self._within_reach(around, reach)
        limit = self._speed_limit(around, clearance, fence_margin)
        first = np.array(((wanted.x, wanted.y, wanted.z), (0.0, 0.0, 0.0)))
        speed = math.hypot(wanted.x, wanted.y)
        found = [Intervention("return_speed", speed, limit)] if speed > limit else []
        first = _capped(first, limit)
        passed, bounds = self._judge(first, around, near, found)
        if passed and not found:
            return Decision(wanted, (), clearance, fence_margin)
        if passed and within_limits(first[:1])[0]:
            return Decision(_vector(first[0]), tuple(found), clearance, fence_margin)
        candidates = _capped(self._held_in(first[0], around, near, bounds), limit)
        chosen = self._nearest(first[0], candidates[within_limits(candidates)], around, near, bounds)
        if chosen is None:
            due = WAY_SHARES * self._due(around, near, bounds.allowed)
            chosen = due[within_limits(due).argmax()]
        return Decision(_vector(chosen), tuple(found), clearance, fence_margin)

    def _in_the_open(self, wanted: CorridorVector, around: Surroundings, room: Room) -> bool:
        """Whether bounds alone show that neither points nor fence nor unseen space are anywhere near."""
        config = self._config
        box = TubeBox.around(around.position, around.start, wanted, config)
        return (
            box.inside(around.position, room, climb_room_m(wanted, config))
            and box.apart_from(around.x_m, around.y_m, around.extra_m + kept_to_points_m(box, config))
            and self._sight.all_clear(box.low_m, box.high_m, around.view)
        )

    def _speed_limit(self, around: Surroundings, clearance_m: float, fence_margin_m: float) -> float:
        """Horizontal speed allowed from here: less inside a margin, outside the fence or in space never seen, m/s."""
        if clearance_m < self._config.margin_m or fence_margin_m < 0.0 or self._sight.lost(around.position, around.view):
            return self._config.return_speed_m_s
        return math.inf

    def _clearance_now(self, around: Surroundings) -> float:
        """Distance between the hull and the nearest known point, or as much as the sensor could have seen, m."""
        if around.x_m.shape[0] == 0:
            return math.inf
        dx, dy = around.x_m - around.position.x, around.y_m - around.position.y
        return math.sqrt(float((dx * dx + dy * dy).min())) - self._config.vehicle_radius_m

    def _reach_m(self, start: Start) -> float:
        """How far from `start` some tube of this tick can come, errors and keep-out included, m."""
        config = self._config
        fast = (
            max(math.hypot(x, y) for x, y, _ in start.velocity_m_s.tolist())
            + config.max_horizontal_speed_m_s * config.tick_s / config.lag_min_s
        )
        apart = math.dist(*start.position_m[:, :2].tolist())
        errors = config.velocity_error_m_s * config.delay_s
        if config.obstacle_speed_m_s > 0.0:
            blind_s = config.dead_time_s + config.tick_s + float(slow_after_s(fast * config.lag_s, config))
            errors += config.obstacle_speed_m_s * blind_s
        stop = config.stop_distance_m(fast + config.max_horizontal_speed_m_s * config.tick_s)
        return config.keep_out_m + apart + errors + stop

    def _within_reach(self, around: Surroundings, reach_m: float) -> Surroundings:
        """Only the points that some tube of this tick can come near to. The view keeps all: also those explain unseen cells."""
        start = around.start
        dx, dy = around.x_m - start.position_m[0, 0], around.y_m - start.position_m[0, 1]
        near = dx * dx + dy * dy < (reach_m + around.extra_m) ** 2
        which = near.nonzero()[0]
        points = around.view.near_m[:, which]
        return Surroundings(points[0], points[1], around.extra_m[which], around.view, around.position, around.start)

    def _judge(self, first: Floats, around: Surroundings, near: NearFence, found: list[Intervention]) -> tuple[bool, Bounds]:
        """Judge the wanted command (row 0) against what braking (row 1) sets."""
        tube = tubes(around.start, first, self._config)
        clear, fence = self._tube_clearances(tube, around), self._guard.rooms_m(tube, around.start, near)
        points, position = np.array((around.x_m, around.y_m)), np.array((around.position.x, around.position.y))
        pressed = np.count_nonzero(fence[1, :-2] < 0.0) + np.count_nonzero(clear[1] < 0.0)
        ways = self._guard.ways_out(tube, near) if pressed else None
        allowed = allowance(tube, clear[1], fence[1], points, position, ways, self._config)
        hidden = self._sight.hidden(tube, around.view)
        braking = slice(1, 2)
        bounds = Bounds(allowed, hidden.rows(braking), tube.rows(braking), ways)
        if not allowed.permits(first[:1], clear[:1], fence[:1])[0]:
            found.extend(_reasons(allowed, first[0], clear[0], fence[0]))
            return False, bounds
        if not bounds.hidden.permits(hidden)[0]:
            found.append(Intervention("unseen", float(hidden.soon[0]), float(hidden.soon[1])))
            return False, bounds
        return True, bounds

    def _held_in(self, wanted: Floats, around: Surroundings, near: NearFence, bounds: Bounds) -> Floats:
        """All candidates [c, 3], turned along the fence, neither climbing nor sinking out of it."""
        allowed = bounds.allowed
        ways = self._guard.ways_out(bounds.brake, near) if bounds.ways is None else bounds.ways
        candidates = held_in(self._candidates(wanted, around, allowed), ways, allowed.push_m_s, self._config)
        np.clip(candidates[:, 2], allowed.sink_m_s, allowed.climb_m_s, out=candidates[:, 2])
        return candidates

    def _nearest(
        self, wanted: Floats, candidates: Floats, around: Surroundings, near: NearFence, bounds: Bounds
    ) -> Floats | None:
        """Of the candidates [c, 3] that pass, the one nearest to the wanted vector [3]."""
        away = candidates - wanted
        candidates = candidates[np.argsort(np.einsum("ci,ci->c", away, away), kind="stable")]
        for few in (candidates[:FIRST_LOOK], candidates[FIRST_LOOK:]):
            passed = self._passing(few, around, near, bounds)
            if passed.shape[0]:
                nearest: Floats = few[passed[0]]
                return nearest
        return None

    def _due(self, around: Surroundings, near: NearFence, allowed: Allowance) -> Floats:
        """The way out of a margin [3], even into the unseen, since what presses is known; else no horizontal command."""
        way = allowed.hover_m_s
        way[:2] = allowed.push_m_s
        tube = tubes(around.start, way[None], self._config)
        clear, rooms = self._tube_clearances(tube, around), self._guard.rooms_m(tube, around.start, near)
        return way if allowed.for_the_way_out(self._config).permits(way[None], clear, rooms)[0] else allowed.hover_m_s

    def _passing(self, candidates: Floats, around: Surroundings, near: NearFence, bounds: Bounds) -> Integers:
        """Indices of the candidates [c, 3] that keep to the bounds; unseen space is counted only for those that pass all else."""
        tube = tubes(around.start, candidates, self._config)
        rooms = self._guard.rooms_m(tube, around.start, near)
        passed = np.flatnonzero(bounds.allowed.permits(candidates, self._tube_clearances(tube, around), rooms))
        if passed.shape[0] == 0:
            return passed
        return passed[bounds.hidden.permits(self._sight.hidden(tube.rows(passed), around.view, bounds.hidden))]

    def _candidates(self, wanted: Floats, around: Surroundings, allowed: Allowance) -> Floats:
        """Candidates [c, 3]: the wanted one, shorter, turned (length by cosine), slid along the nearest obstacle, hover."""
        x, y, z = wanted.tolist()
        a, b = self._scaled[:, 0], self._scaled[:, 1]
        slid = 2 * len(OUTWARD) if around.x_m.shape[0] else 0
        shorter = a.shape[0]
        plain = np.empty((shorter + 3 + slid, 3))
        plain[:, 2] = z
        plain[:shorter, 0], plain[:shorter, 1] = a * x - b * y, a * y + b * x
        plain[shorter], plain[shorter + 1, :2], plain[shorter + 2] = wanted, 0.0, 0.0
        if slid:
            plain[shorter + 3 :] = self._slid(wanted, around, allowed.brake_stop_m)
        push = allowed.push_m_s
        if not push.any():
            return plain
        pushed = np.concatenate((plain, plain, plain))
        for k, share in enumerate(PUSHES, start=1):
            pushed[k * plain.shape[0] : (k + 1) * plain.shape[0], :2] += share * push
        return pushed

    def _slid(self, wanted: Floats, around: Surroundings, stops_m: Floats) -> Floats:
        """The wanted vector without its part towards the points nearest to where braking ends [2 models, 3], [2 x 2, 3]."""
        dx, dy = stops_m[:, :1] - around.x_m, stops_m[:, 1:2] - around.y_m
        distance = np.hypot(dx, dy)
        length, rows = math.hypot(wanted[0], wanted[1]), []
        for model, nearest in enumerate((distance - around.extra_m).argmin(axis=1)):
            normal = np.array((dx[model, nearest], dy[model, nearest], 0.0)) / max(float(distance[model, nearest]), EPSILON_M)
            inward = min(0.0, float(wanted @ normal))
            rows += [wanted - (inward - share * length) * normal for share in OUTWARD]
        return np.array(rows)

    def _tube_clearances(self, tube: Tubes, around: Surroundings) -> Floats:
        """Smallest distance beyond keep-out between each tube and each known point, [c, k], m."""
        config, error = self._config, self._config.velocity_error_m_s
        # the way from begin to turn is one tick long: begin is past choosing, turn is judged as the leg's begin
        turned = (error + config.obstacle_speed_m_s) * (config.dead_time_s + config.tick_s)
        grown: Floats | float = error * config.lag_s
        if config.obstacle_speed_m_s > 0.0:
            leg = tube.stop_m - tube.turn_m
            grown = grown + config.obstacle_speed_m_s * slow_after_s(np.hypot(leg[..., 0], leg[..., 1]), config).reshape(-1, 1)
        return _leg_clearances(tube, turned, grown, around) - config.keep_out_m


def _reasons(allowed: Allowance, wanted: Floats, clear_m: Floats, fence_m: Floats) -> list[Intervention]:
    """Which rules refuse the wanted command [3], each at its worst place."""
    reasons: list[Intervention] = []
    face = int(np.argmin(fence_m - allowed.fence_m))
    outside = max(allowed.sink_m_s - wanted[2], wanted[2] - allowed.climb_m_s) > EPSILON_M
    if outside or fence_m[face] < allowed.fence_m[face] - EPSILON_M:
        reasons.append(Intervention("fence", float(fence_m[face]), float(allowed.fence_m[face])))
    if clear_m.shape[0]:
        worst = int(np.argmin(clear_m - allowed.clearance_m))
        if clear_m[worst] < allowed.clearance_m[worst] - EPSILON_M:
            reasons.append(Intervention("obstacle", float(clear_m[worst]), float(allowed.clearance_m[worst])))
    lacking = float(allowed.shortfall_m_s(wanted[None])[0])
    if lacking > EPSILON_M:
        reasons.append(Intervention("hold_off", lacking, 0.0))
    return reasons


def _leg_clearances(tube: Tubes, error_m: float, grown_m: Floats | float, around: Surroundings) -> Floats:
    """Smallest distance from the tubes' straight legs to the points, less errors that grow along the leg, [c, k], m.

    `error_m`: at the leg's begin; `grown_m`: added at its end, one for all or [2 models x c, 1].
    """
    begin_m, end_m = tube.turn_m, tube.stop_m
    if around.x_m.shape[0] == 0:
        return np.empty((begin_m.shape[1], 0))
    ax, ay, _ = begin_m.reshape(-1, 3).T[..., None]
    dx, dy, _ = (end_m - begin_m).reshape(-1, 3).T[..., None]
    rx, ry = around.x_m - ax, around.y_m - ay
    along = (rx * dx + ry * dy) / np.maximum(dx * dx + dy * dy, 1e-12)
    np.minimum(np.maximum(along, 0.0, out=along), 1.0, out=along)
    rx -= along * dx
    ry -= along * dy
    distance = np.sqrt(rx * rx + ry * ry)
    distance -= around.extra_m
    along *= grown_m
    distance -= along
    slow, fast = distance.reshape(*begin_m.shape[:2], around.x_m.shape[0])
    nearest: Floats = np.minimum(slow, fast) - error_m
    return nearest


def _capped(candidates: Floats, limit_m_s: float) -> Floats:
    """Velocities [c, 3] whose horizontal part is shortened to a limit."""
    if limit_m_s == math.inf:
        return candidates
    speed = np.hypot(candidates[:, 0], candidates[:, 1])
    if not (speed > limit_m_s).any():
        return candidates
    shorter = candidates.copy()
    shorter[:, :2] *= (limit_m_s / np.maximum(speed, limit_m_s))[:, None]
    return shorter


def _vector(values: Floats) -> CorridorVector:
    return CorridorVector(float(values[0]), float(values[1]), float(values[2]))
