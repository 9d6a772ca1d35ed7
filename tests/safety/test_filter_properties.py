"""Properties of `SafetyFilter` for any input (safety notes section 5), by hypothesis."""

from __future__ import annotations

import copy
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from safety_plant import FENCE, cast, command, config, scan, state

from safety.braking import predict_start, tubes
from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.messages import LidarScan, SafeCommand, VehicleState, VelocityCommand

quick = settings(max_examples=60, deadline=None)
ROUNDED_M_S = 5e-3  # ranges are 32 bit numbers; the way out between contradictions magnifies their rounding
speed = st.floats(-1.2, 1.2)
wild = st.one_of(st.floats(), st.floats(-2.0, 2.0), st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324]))
angle = st.floats(-math.pi, math.pi)
wild_vector = st.builds(CorridorVector, wild, wild, wild)
box = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(0.1, 1.0), st.floats(0.1, 1.0)).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)
boxes_around = st.lists(box, min_size=0, max_size=4)
FREE = {"max_acceleration_m_s2": 1000.0, "max_jerk_m_s3": 1000.0}
X0, Y0 = 15.0, 0.0  # the vehicle's place in the middle of the fence
XC, YC = 15.05, 0.05  # the same in the middle of a cell of the map: turning and mirroring about it maps cells onto cells


def view(boxes, x=X0, y=Y0, yaw=0.0, time_s=0.0, centre=(X0, Y0)) -> LidarScan:
    """A scan of boxes given relative to `centre`."""
    placed = np.array([(b[0] + centre[0], b[1] + centre[1], b[2] + centre[0], b[3] + centre[1]) for b in boxes]).reshape(-1, 4)
    blank = scan(time_s=time_s)
    bearings = blank.angle_min_rad + blank.angle_increment_rad * np.arange(180)
    return dataclasses.replace(blank, ranges_m=cast(placed, x, y, bearings + yaw).astype(np.float32))


def once(wanted, pose, seen, now_s=0.0, **changes) -> tuple[SafeCommand, object]:
    """One call of a fresh filter that may step its command as far as it likes."""
    return SafetyFilter(config(**(FREE | changes))).apply(wanted, pose, seen, now_s)


def away(wanted: VelocityCommand, sent: SafeCommand) -> float:
    """How far what is sent is from what was wanted."""
    a, b = wanted.velocity, sent.velocity
    return math.hypot(a.x - b.x, a.y - b.y, a.z - b.z)


def norm(v: CorridorVector) -> float:
    return math.hypot(v.x, v.y, v.z)


def outside(boxes, margin: float = 0.1) -> bool:
    """Whether the vehicle's centre is this far outside every box."""
    return all(max(b[0], -b[2], b[1], -b[3]) > margin for b in boxes)


def wall(distance: float):
    """A long wall across the way, its face `distance` ahead of the vehicle."""
    return [(distance, -3.0, distance + 1.0, 3.0)]


def wild_scan(draw_ranges, time_s, angle_min, step, low, high):
    return LidarScan(time_s, np.array(draw_ranges, dtype=np.float32), angle_min, step, low, high)


@given(
    st.one_of(st.none(), st.builds(VelocityCommand, wild_vector, wild)),
    st.one_of(st.none(), st.builds(VehicleState, wild, wild_vector, wild_vector, wild_vector, wild, wild, wild, wild)),
    st.one_of(st.none(), st.builds(wild_scan, st.lists(wild, max_size=40), wild, wild, wild, wild, wild)),
    wild,
)
@settings(max_examples=300, deadline=None)
def test_any_input_gives_a_finite_command_inside_all_limits(wanted, pose, seen, now_s):
    with np.errstate(all="ignore"):
        safety = SafetyFilter(config())
        for _ in range(2):
            sent, verdict = safety.apply(wanted, pose, seen, now_s)
            v = sent.velocity
            assert all(map(math.isfinite, (v.x, v.y, v.z, sent.yaw_rate_rad_s)))
            assert math.hypot(v.x, v.y) <= 1.2 * (1 + 1e-9)
            assert abs(v.z) <= 0.5
            assert abs(sent.yaw_rate_rad_s) <= 1.0
            assert verdict.fault is None or norm(v) == 0.0


@given(
    st.builds(VelocityCommand, wild_vector, wild),
    st.lists(st.one_of(st.floats(0.0, 5.0), wild), min_size=180, max_size=180),
    st.tuples(speed, speed, st.floats(-0.5, 0.5)),
    st.floats(-0.5, 0.5),
    st.floats(-0.5, 0.5),
    angle,
)
@quick
def test_any_scan_and_command_with_a_good_state_stays_inside_the_limits(wanted, ranges, v, roll, pitch, yaw):
    with np.errstate(all="ignore"):
        sent, _ = once(wanted, state(x=X0, v=v, roll=roll, pitch=pitch, yaw=yaw), scan(ranges))
    assert math.hypot(sent.velocity.x, sent.velocity.y) <= 1.2 * (1 + 1e-9)
    assert abs(sent.velocity.z) <= 0.5
    assert abs(sent.yaw_rate_rad_s) <= 1.0


@given(st.floats(-0.7, 0.7), st.floats(-0.5, 0.5), st.floats(-1, 1), st.floats(0.0, 0.9), angle)
@quick
def test_away_from_everything_the_command_is_unchanged_bit_for_bit(turn, vz, rate, length, yaw):
    direction = yaw + turn
    wanted = command(length * math.cos(direction), length * math.sin(direction), vz, rate)
    sent, verdict = once(wanted, state(x=X0, yaw=yaw), scan())
    assert sent.velocity == wanted.velocity
    assert sent.yaw_rate_rad_s == wanted.yaw_rate_rad_s
    assert verdict.interventions == ()
    assert not verdict.braking


@given(boxes_around, st.tuples(speed, speed, st.floats(-0.5, 0.5)), angle)
@quick
def test_zero_is_allowed_unless_drift_must_be_held_off(boxes, v, yaw):
    assume(outside(boxes))
    sent, verdict = once(command(), state(x=X0, v=v, yaw=yaw), view(boxes, yaw=yaw))
    rules = {found.rule for found in verdict.interventions}
    assert rules <= {"hold_off"}
    assert norm(sent.velocity) <= (1.5 * 0.25 + 1e-9 if rules else 0.0)


@given(boxes_around, speed, speed, st.floats(-0.5, 0.5), st.floats(-0.8, 0.8), st.floats(-0.4, 0.4))
@quick
def test_filtering_twice_is_filtering_once(boxes, ux, uy, uz, vx, vy):
    """What the filter sends would pass the filter unchanged in the same situation."""
    pose, seen = state(x=X0, v=(vx, vy, 0)), view(boxes)
    safety = SafetyFilter(config(**FREE))
    again = copy.deepcopy(safety)
    sent, _ = safety.apply(command(ux, uy, uz, 0.3), pose, seen, 0.0)
    twice, _ = again.apply(VelocityCommand(sent.velocity, sent.yaw_rate_rad_s), pose, seen, 0.0)
    assert norm(CorridorVector(*(np.subtract(dataclasses.astuple(twice.velocity), dataclasses.astuple(sent.velocity))))) < 1e-9


@given(st.floats(0.6, 3.0), st.floats(0.0, 0.5), st.floats(0.1, 1.0), st.floats(0.0, 0.6))
@quick
def test_nearer_wall_never_allows_more(distance, nearer, wanted, v):
    pose = state(x=X0, v=(v, 0, 0))
    far, _ = once(command(wanted), pose, view(wall(distance)))
    near, _ = once(command(wanted), pose, view(wall(distance - nearer)))
    assert near.velocity.x <= max(far.velocity.x, 0.0) + 1e-9


@pytest.mark.parametrize(
    ("field", "worse"),
    [
        ("margin_m", 0.3),
        ("vehicle_radius_m", 0.6),
        ("velocity_error_m_s", 0.3),
        ("dead_time_s", 0.5),
        ("lag_s", 1.2),
        ("obstacle_speed_m_s", 0.5),
        ("tick_s", 0.2),
    ],
)
@given(distance=st.floats(0.8, 2.5), wanted=st.floats(0.2, 1.0), v=st.floats(0.0, 0.4))
@settings(max_examples=25, deadline=None)
def test_larger_error_delay_or_size_never_allows_more(field, worse, distance, wanted, v):
    pose, seen = state(x=X0, v=(v, 0, 0)), view(wall(distance))
    normal, _ = once(command(wanted), pose, seen)
    careful, _ = once(command(wanted), pose, seen, **{field: worse})
    assert careful.velocity.x <= normal.velocity.x + 1e-9


@given(st.floats(0.8, 2.5), st.floats(0.2, 1.0), st.floats(0.0, 0.6), st.floats(0.0, 0.19))
@quick
def test_older_data_never_allows_more(distance, wanted, v, age):
    """The same scan and state, read later: the vehicle has flown on meanwhile."""
    pose, seen = state(x=X0, v=(v, 0, 0)), view(wall(distance))
    fresh, _ = once(command(wanted), pose, seen, 0.0)
    old, _ = once(command(wanted), pose, seen, age)
    assert old.velocity.x <= max(fresh.velocity.x, 0.0) + 1e-9


@given(st.floats(0.7, 2.5), st.floats(0.2, 1.0), st.integers(0, 179))
@quick
def test_unknown_never_allows_more_than_free(distance, wanted, lost):
    ranges = view(wall(distance)).ranges_m.copy()
    ranges[max(0, lost - 30) : lost] = np.nan
    unknown, _ = once(command(wanted), state(x=X0), scan(ranges))
    ranges[np.isnan(ranges)] = np.inf
    free, _ = once(command(wanted), state(x=X0), scan(ranges))
    assert away(command(wanted), unknown) >= away(command(wanted), free) - 1e-9


@given(boxes_around, st.integers(0, 3), speed, speed)
@quick
def test_removing_an_obstacle_never_adds_a_restriction(boxes, index, ux, uy):
    """From a place that keeps all margins."""
    assume(outside(boxes, 0.6))
    fewer = [b for k, b in enumerate(boxes) if k != index]
    full, verdict = once(command(ux, uy), state(x=X0), view(boxes))
    assume(verdict.clearance_m > 0.2)
    if norm(full.velocity) == norm(command(ux, uy).velocity):
        assert once(command(ux, uy), state(x=X0), view(fewer))[0].velocity == full.velocity


@given(boxes_around, speed, speed, st.floats(-0.8, 0.8), st.floats(-0.4, 0.4))
@example([(0.0, 0.3125, 1.0, 1.3125)], 0.0, 1.0, 0.0, 0.0)
@quick
def test_mirrored_world_gives_the_mirrored_command(boxes, ux, uy, vx, vy):
    """Edge 25: a filter that confuses left and right fails here."""
    assume(outside(boxes))
    mirrored = [(b[0], -b[3], b[2], -b[1]) for b in boxes]
    here, _ = once(command(ux, uy), state(x=XC, y=YC, v=(vx, vy, 0)), view(boxes, XC, YC, centre=(XC, YC)))
    there, _ = once(command(ux, -uy), state(x=XC, y=YC, v=(vx, -vy, 0)), view(mirrored, XC, YC, centre=(XC, YC)))
    # the map has no middle row of cells, and a direction on the border of two sectors counts in the other one when mirrored
    assert away(command(ux, uy), here) == pytest.approx(away(command(ux, -uy), there), abs=5e-2)


@given(boxes_around, st.sampled_from([1, 2, 3]), speed, speed, st.floats(-0.8, 0.8))
@quick
def test_turned_world_gives_the_turned_command(boxes, quarters, ux, uy, v):
    """Quarter turns of world, vehicle and command; the box fence is far away."""
    assume(outside(boxes))
    turned, c, s = [], round(math.cos(quarters * math.pi / 2)), round(math.sin(quarters * math.pi / 2))
    for x0, y0, x1, y1 in boxes:
        xs, ys = sorted((c * x0 - s * y0, c * x1 - s * y1)), sorted((s * x0 + c * y0, s * x1 + c * y1))
        turned.append((xs[0], ys[0], xs[1], ys[1]))
    yaw = quarters * math.pi / 2
    wide = FENCE.model_copy(update={"min_m": (-100.0, -100.0, 0.3), "max_m": (100.0, 100.0, 4.0)})
    here, _ = once(command(ux, uy), state(x=XC, y=YC, v=(v, 0, 0)), view(boxes, XC, YC, centre=(XC, YC)), fence=wide)
    wanted = command(c * ux - s * uy, s * ux + c * uy)
    there, _ = once(
        wanted, state(x=XC, y=YC, v=(c * v, s * v, 0), yaw=yaw), view(turned, XC, YC, yaw=yaw, centre=(XC, YC)), fence=wide
    )
    assert away(wanted, there) == pytest.approx(away(command(ux, uy), here), abs=ROUNDED_M_S)


@given(boxes_around, speed, speed, st.integers(-80, 80), st.integers(-20, 20))
@quick
def test_shifted_world_gives_the_same_command(boxes, ux, uy, cells_x, cells_y):
    """By whole cells of the map."""
    assume(outside(boxes))
    wide = FENCE.model_copy(update={"min_m": (-100.0, -100.0, 0.3), "max_m": (100.0, 100.0, 4.0)})
    here, _ = once(command(ux, uy), state(x=XC, y=YC), view(boxes, XC, YC, centre=(XC, YC)), fence=wide)
    x, y = XC + 0.1 * cells_x, YC + 0.1 * cells_y
    there, _ = once(command(ux, uy), state(x=x, y=y), view(boxes, x, y, centre=(x, y)), fence=wide)
    assert away(command(ux, uy), there) == pytest.approx(away(command(ux, uy), here), abs=ROUNDED_M_S)


@given(boxes_around, speed, speed, st.integers(-3, 3))
@example([(0.28, 0.0, 1.28, 1.0)], 0.0, 0.0, 1)
@quick
def test_yaw_counts_modulo_a_full_turn(boxes, ux, uy, turns):
    """Edge 15: yaw wraps."""
    assume(outside(boxes))
    here, _ = once(command(ux, uy), state(x=X0), view(boxes))
    there, _ = once(command(ux, uy), state(x=X0, yaw=2 * math.pi * turns), view(boxes))
    # pressed upon a box, rounding may put a direction on the border of two sectors into the other one
    assert away(command(ux, uy), there) == pytest.approx(away(command(ux, uy), here), abs=1e-2)


def flight(commands, boxes, shift_s=0.0, safety=None):
    """What a filter sends for a list of commands from a slowly drifting vehicle."""
    safety, result = safety or SafetyFilter(config()), []
    for k, (ux, uy) in enumerate(commands):
        time_s = shift_s + 0.0625 * k
        pose = state(x=X0 + 0.01 * k, v=(0.2, 0, 0), time_s=time_s)
        result.append(safety.apply(command(ux, uy), pose, view(boxes, X0 + 0.01 * k, time_s=time_s), time_s))
    return result


@given(boxes_around, st.lists(st.tuples(speed, speed), min_size=1, max_size=8), st.integers(-1000, 1000))
@quick
def test_the_clock_may_start_anywhere(boxes, commands, shift):
    here = [sent for sent, _ in flight(commands, boxes)]
    there = [sent for sent, _ in flight(commands, boxes, float(shift))]
    for ours, theirs in zip(here, there, strict=True):
        difference = np.subtract(dataclasses.astuple(ours.velocity), dataclasses.astuple(theirs.velocity))
        assert np.abs(difference).max() < 1e-6


@given(boxes_around, st.lists(st.tuples(speed, speed), min_size=1, max_size=8))
@quick
def test_same_input_gives_the_same_output_also_after_reset(boxes, commands):
    used = SafetyFilter(config())
    first = flight(commands, boxes, safety=used)
    used.reset()
    assert repr(flight(commands, boxes, safety=used)) == repr(first)
    assert repr(flight(commands, boxes)) == repr(first)


@given(st.lists(st.tuples(speed, speed, st.floats(-0.5, 0.5)), min_size=2, max_size=12))
@quick
def test_commands_grow_and_turn_no_faster_than_the_acceleration_limit(commands):
    """Away from obstacles, seeing all round. Slowing down along the last command is free; what is added is bounded."""
    safety, last = SafetyFilter(config(max_acceleration_m_s2=2.0)), np.zeros(3)
    for k, wanted in enumerate(commands):
        time_s = 0.05 * k
        sent, _ = safety.apply(
            command(*wanted), state(x=X0, time_s=time_s), scan(beams=360, fov=2 * math.pi, time_s=time_s), time_s
        )
        now = np.array(dataclasses.astuple(sent.velocity))
        keep = float(np.clip(now @ last / max(last @ last, 1e-12), 0.0, 1.0))
        limit = 2.0 * (0.1 if k == 0 else 0.05)
        assert np.linalg.norm(now - keep * last) <= limit + 1e-6 or np.linalg.norm(now) <= np.linalg.norm(last) + 1e-9
        last = now


place = st.tuples(st.floats(-1.5, 36.5), st.floats(-5.5, 5.5), st.floats(0.5, 3.8))


@given(place, st.tuples(speed, speed, st.floats(-0.5, 0.5)), st.tuples(speed, speed, st.floats(-0.5, 0.5)), angle)
@settings(max_examples=200, deadline=None)
def test_the_stop_point_stays_inside_the_fence_or_no_further_out_than_braking(where, v, wanted, yaw):
    c, pose = config(**FREE), state(*where, v=v, yaw=yaw)
    safety = SafetyFilter(c)
    sent, _ = safety.apply(command(*wanted), pose, scan(), 0.0)
    fresh = SafetyFilter(c)
    start = predict_start(pose, fresh._history, 0.0, c)
    both = tubes(start, np.array([dataclasses.astuple(sent.velocity), (0.0, 0.0, 0.0)]), c).stop_m
    low, high = np.array((-1.56, -5.56, 0.49)), np.array((36.56, 5.56, 3.81))
    inside = np.minimum(both - low, high - both).min(axis=0)
    assert (inside[0] >= np.minimum(inside[1], 0.0) - 1e-6).all()


@given(boxes_around, st.tuples(speed, speed), st.tuples(speed, speed), angle)
@settings(max_examples=150, deadline=None)
def test_accepted_tube_keeps_the_hull_off_every_return(boxes, wanted, v, yaw):
    """Oracle: sample both models densely in time; unless braking itself comes nearer, no sample is inside the keep-out."""
    c, pose, seen = config(**FREE), state(x=X0, v=(*v, 0), yaw=yaw), view(boxes, yaw=yaw)
    sent, _ = SafetyFilter(c).apply(command(*wanted), pose, seen, 0.0)
    bearings = yaw + seen.angle_min_rad + seen.angle_increment_rad * np.arange(180)
    hit = np.isfinite(seen.ranges_m)
    points = np.stack((X0 + seen.ranges_m * np.cos(bearings), seen.ranges_m * np.sin(bearings)), axis=1)[hit]

    def nearest(u, lag):
        x, vel, u, best, h = np.array((X0, 0.0)), np.array(v), np.array(u), np.full(len(points), math.inf), 0.01
        for k in range(400):
            target = np.array(v) if k < 20 else (u if k < 25 else np.zeros(2))
            rate = c.lag_s if k >= 25 else lag
            vel = vel + (target - vel) * (1 - math.exp(-h / rate))
            x = x + vel * h
            if k >= 25:
                best = np.minimum(best, np.hypot(*(points - x).T))
        return best

    for lag in (c.lag_s, c.lag_min_s):
        chosen, brake = nearest((sent.velocity.x, sent.velocity.y), lag), nearest((0.0, 0.0), lag)
        assert (chosen >= np.minimum(c.keep_out_m - c.margin_m, brake) - 0.02).all()


@given(st.floats(0.36, 0.6), st.floats(-math.pi / 2 + 0.3, math.pi / 2 - 0.3))
@quick
def test_the_way_back_is_never_frozen(distance, bearing):
    """Standing too near to something seen, in any direction ahead: flying straight away from it is allowed, at return speed."""
    x, y = distance * math.cos(bearing), distance * math.sin(bearing)
    seen = view([(x, y, x + 0.01, y + 0.01), (x - 0.01, y - 0.01, x, y)])
    wanted = command(-math.cos(bearing), -math.sin(bearing))
    sent, _ = once(wanted, state(x=X0), seen)
    assert norm(sent.velocity) >= 0.3 - 1e-9


@given(place, st.floats(0.1, 3.0), st.integers(0, 5))
@quick
def test_outside_the_fence_only_the_way_back_is_open(where, out, face):
    p, axis = list(where), face % 3
    p[axis] = (FENCE.min_m[axis] - out) if face < 3 else (FENCE.max_m[axis] + out)
    inward = 1.0 if face < 3 else -1.0
    u = [0.0, 0.0, 0.0]
    u[axis] = 0.4 * inward
    home, verdict = once(command(*u), state(*p), scan(), ground_z_m=-100.0)
    assert dataclasses.astuple(home.velocity)[axis] * inward > 0.0
    assert verdict.fence_margin_m < 0.0
    u[axis] *= -1.0
    further = dataclasses.astuple(once(command(*u), state(*p), scan(), ground_z_m=-100.0)[0].velocity)[axis]
    assert 0.0 <= further * inward <= 0.25
