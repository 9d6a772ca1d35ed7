"""What a command may do this tick, derived from what braking would do: the yardstick of the shield.

Braking must always stay available, so nothing may be worse than braking. Beyond that:

* a point, edge or vertex that braking keeps clear of by the full margin must be kept clear of by the full margin;
* once braking comes inside a margin anywhere, the fence's included, other points may be neared to a quarter of theirs, so that a
  vehicle can slide along;
* a vehicle under a zero command still drifts by the error of its velocity estimate. Where it stands, or will after braking, a
  little inside a margin, a command must therefore lead out again: slowly, and only so far in that drift explains it;
* where braking itself would bring the hull onto a point, no command may have any part towards it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from safety.braking import Tubes, stop_gain_s
from safety.config import SafetyConfig
from safety.fence_tube import WaysOut

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
EPSILON_M = 1e-9  # rounding of one check
SLIDE_SHARE = 0.25  # of the margin: how far inside points may be neared, and where holding off begins
HOLD_OFF_PER_S = 10.0  # speed outwards per metre inside; acts on the stop point, which follows a command at once
POINT_BAND_M = 0.05  # hold off from points up to this far inside the hull; deeper is no drift
FENCE_BAND_M = 0.5  # the same for the fence
PUSH_ROUNDS = 6  # each may find that something else is now unmet
SECTORS = 16
BOUND_WEIGHT = 1e4
NEAR_M = 0.05  # room that the way out of one margin may take from another
PROJECTIONS = 3  # two edges that meet, and back
_LEAST_M = 1e-6
_NO_NORMALS, _NO_SPEEDS = np.empty((2, 0)), np.empty(0)


@dataclass(frozen=True, slots=True)
class Allowance:
    """Bounds on candidate commands of one tick.

    `clearance_m` [k], `fence_m` [f]: least clearance of the tube beyond keep-out to each point, least room to each near piece of
    the fence, floor and ceiling (last two). `normals` [2, h], `outward_m_s` [h]: least part of a command along each horizontal
    direction. `push_m_s` [2]: a small horizontal command that does all that is due, zeros when nothing is. `sink_m_s`,
    `climb_m_s`: least and greatest vertical command. `brake_stop_m` [2 models, 3].
    """

    clearance_m: Floats
    fence_m: Floats
    normals: Floats
    outward_m_s: Floats
    push_m_s: Floats
    sink_m_s: float
    climb_m_s: float
    brake_stop_m: Floats

    def shortfall_m_s(self, candidates: Floats) -> Floats:
        """How much commands [c, 3] lack of the outward speed that is due, at the worst point, m/s; <= 0 is fine."""
        if self.outward_m_s.shape[0] == 0:
            return np.full(candidates.shape[0], -np.inf)
        lacking: Floats = (self.outward_m_s - candidates[:, :2] @ self.normals).max(axis=1)
        return lacking

    def permits(self, candidates: Floats, clear_m: Floats, fence_m: Floats) -> Booleans:
        """Which commands [c, 3], with tube clearances [c, k] and fence rooms [c, f], pass."""
        clear = (clear_m >= self.clearance_m - EPSILON_M).all(axis=1)
        inside = (fence_m >= self.fence_m - EPSILON_M).all(axis=1)
        level = (candidates[:, 2] >= self.sink_m_s - EPSILON_M) & (candidates[:, 2] <= self.climb_m_s + EPSILON_M)
        permitted: Booleans = clear & inside & level & (self.shortfall_m_s(candidates) <= EPSILON_M)
        return permitted

    def for_the_way_out(self, config: SafetyConfig) -> Allowance:
        """The same for what leads out of a margin: it may near other points within theirs, as far as the worst is without it."""
        worst = max(float(self.clearance_m.min(initial=0.0)), -config.margin_m)
        return replace(self, clearance_m=np.minimum(self.clearance_m, worst))

    @property
    def hover_m_s(self) -> Floats:
        """No horizontal command [3]; vertically none either, but for what leads back from floor or ceiling."""
        return np.array((0.0, 0.0, min(max(0.0, self.sink_m_s), self.climb_m_s)))


def allowance(
    tube: Tubes,
    clear_m: Floats,
    fence_m: Floats,
    points_m: Floats,
    position_m: Floats,
    ways: WaysOut | None,
    config: SafetyConfig,
) -> Allowance:
    """The allowance set by braking.

    `tube`: brake tubes whose last candidate is zero velocity; `clear_m` [k], `fence_m` [f]: its clearances; `points_m` [2, k];
    `position_m` [2]: the vehicle now; `ways`: out of the fence's margins, where braking comes into any.
    """
    slide = -SLIDE_SHARE * config.margin_m
    worst = min(float(clear_m.min(initial=0.0)), float(fence_m[:-2].min(initial=0.0)))
    normals, due = _outward(tube, clear_m, points_m, position_m, ways is not None, config)
    if ways is not None:
        normals, due = np.concatenate((normals, ways.normals), axis=1), np.concatenate((due, _fence_due_m_s(ways, config)))
    push: Floats = np.zeros(2)
    if due.shape[0]:
        push = _way_out_m_s(normals, due, config)
        asked = due >= 0.0
        normals, due = normals[:, asked], due[asked]
        due = _as_pushed(due, normals, push)
    gain_s = stop_gain_s(config)
    sink, climb = (_vertical_bound(room_m, gain_s, config) for room_m in fence_m[-2:].tolist())
    return Allowance(
        clearance_m=np.minimum(clear_m, max(worst, slide)),
        fence_m=np.minimum(0.0, fence_m),
        normals=normals,
        outward_m_s=due,
        push_m_s=push,
        sink_m_s=-sink,
        climb_m_s=climb,
        brake_stop_m=tube.stop_m[:, -1],
    )


def _as_pushed(due_m_s: Floats, normals: Floats, push_m_s: Floats) -> Floats:
    """What is due [h], but of a demand no more than the push does: asked for more, no command would pass."""
    return np.where(due_m_s > 0.0, np.minimum(due_m_s, push_m_s @ normals), due_m_s)


def _outward(
    tube: Tubes, clear_m: Floats, points_m: Floats, position_m: Floats, fenced: bool, config: SafetyConfig
) -> tuple[Floats, Floats]:
    """Directions [2, h] away from the points that braking comes near to, and the speed due along each [h].

    Positive: it comes too near; zero: onto the point; negative: there is room, but the way out of something else may not use up
    more. `fenced`: that something may be the fence.
    """
    if clear_m.shape[0] == 0:
        return _NO_NORMALS, _NO_SPEEDS
    slide = SLIDE_SHARE * config.margin_m
    here = points_m - position_m[:, None]
    depth_here = config.keep_out_m - slide - np.sqrt((here * here).sum(axis=0))
    depth = np.maximum(-clear_m - slide, depth_here)
    if not fenced and not np.count_nonzero(depth > 0.0):  # the usual case
        return _NO_NORMALS, _NO_SPEEDS
    near = depth > -NEAR_M
    near_now, depth, points = (depth_here >= depth)[near], depth[near], points_m[:, near]
    begin, stop = tube.turn_m[0, -1, :2, None], tube.stop_m[0, -1, :2, None]
    leg = stop - begin
    share = np.clip(((points - begin) * leg).sum(axis=0) / max(float((leg * leg).sum()), _LEAST_M**2), 0.0, 1.0)
    from_here = near_now | (depth > config.margin_m)  # the side of a point is that of the vehicle, not that of a tube beyond it
    away = np.where(from_here, position_m[:, None], begin + share * leg) - points
    away /= np.maximum(np.sqrt((away * away).sum(axis=0)), _LEAST_M)
    due = np.where(depth <= config.margin_m + POINT_BAND_M, _hold_off_m_s(depth, config), 0.0)
    return away, np.where(depth > 0.0, due, depth / stop_gain_s(config))


def _way_out_m_s(normals: Floats, due_m_s: Floats, config: SafetyConfig) -> Floats:
    """The command [2] that leads out along all directions [2, h] as fast as is due; between contradictions it ends half way.

    Least squares over what is unmet, one demand per sector, so that it does not count how many points lie on which side; what is
    due and not above zero is a bound, and weighs more. Longer than the return speed the command is shortened.
    """
    way: Floats = np.zeros(2)
    strongest = _strongest_per_sector(normals, due_m_s)
    held, due = normals[:, strongest], due_m_s[strongest]
    weight = np.where(due > 0.0, 1.0, BOUND_WEIGHT)
    for _ in range(PUSH_ROUNDS):
        unmet = due > way @ held
        if not np.count_nonzero(unmet):
            break
        active, weighted = held[:, unmet], held[:, unmet] * weight[unmet]
        way[:] = np.linalg.solve(weighted @ active.T + EPSILON_M * np.eye(2), weighted @ due[unmet])
    return way * min(1.0, (config.return_speed_m_s - EPSILON_M) / max(float(np.hypot(way[0], way[1])), _LEAST_M))


def _strongest_per_sector(normals: Floats, due_m_s: Floats) -> NDArray[np.intp]:
    """Of directions [2, h], the index of the one with the greatest demand in each sector that has any."""
    sector = np.floor(np.arctan2(normals[1], normals[0]) * (SECTORS / (2.0 * np.pi))).astype(np.intp) % SECTORS
    order = np.argsort(due_m_s)
    strongest = np.full(SECTORS, -1)
    strongest[sector[order]] = order  # the last one written counts
    return strongest[strongest >= 0]


def _vertical_bound(room_m: float, gain_s: float, config: SafetyConfig) -> float:
    """Greatest command towards floor or ceiling: the stop point reaches it at most; beyond it, back inwards (negative)."""
    depth = -room_m - SLIDE_SHARE * config.margin_m
    inward = float(_fence_hold_off_m_s(np.array(depth), config)) if depth > 0.0 else 0.0
    return -inward if inward > 0.0 else max(room_m, 0.0) / gain_s


def _fence_hold_off_m_s(depth_m: Floats, config: SafetyConfig) -> Floats:
    """Speed due back inwards at depths > 0: none where it is more than drift."""
    return np.where(depth_m <= FENCE_BAND_M, _hold_off_m_s(depth_m, config), 0.0)


def _fence_due_m_s(ways: WaysOut, config: SafetyConfig) -> Floats:
    """Least part of a command along each way out of the fence's margin: back where drift led in, else as far as there is room.

    What is kept for a fault's drift is not pressed for: an obstacle on the other side counts for more.
    """
    depth = -ways.room_m - SLIDE_SHARE * config.margin_m - config.fault_room_m
    return np.where(depth > 0.0, _fence_hold_off_m_s(depth, config), -np.maximum(ways.room_m, 0.0) / stop_gain_s(config))


def held_in(candidates: Floats, ways: WaysOut, push_m_s: Floats, config: SafetyConfig) -> Floats:
    """Candidates [c, 3] turned along the fence: the stop point may reach each near piece, and no further.

    A few times the part that breaks the worst bound is taken off; in a corner that converges. What is still left is judged later.
    """
    if ways.room_m.shape[0] == 0:
        return candidates
    due = _as_pushed(_fence_due_m_s(ways, config), ways.normals, push_m_s)
    held, rows = candidates.copy(), np.arange(candidates.shape[0])
    for _ in range(PROJECTIONS):
        lacking = due - held[:, :2] @ ways.normals
        worst = np.argmax(lacking, axis=1)
        held[:, :2] += np.maximum(lacking[rows, worst], 0.0)[:, None] * ways.normals.T[worst]
    return held


def _hold_off_m_s(depth_m: Floats, config: SafetyConfig) -> Floats:
    speed: Floats = np.minimum(HOLD_OFF_PER_S * depth_m, config.hold_off_speed_m_s)
    return speed
