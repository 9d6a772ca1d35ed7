"""Where braking itself leads through unseen space it is the yardstick: no command goes deeper, and none runs after old memory."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safety_plant import Plant, cast, command, config, scan, state

from safety.braking import Start, tubes
from safety.filter import SafetyFilter
from safety.free_space import CELL_M, FreeSpace
from safety.lidar import BeamTable, see
from safety.sight import Sight, View

C = config()
NONE = np.empty((2, 0))
HULL_M = 0.35
MEMORY_S = 4.0


def engaged_without_sight(x: float = 0.05, y: float = 0.05) -> FreeSpace:
    """Nothing known but the place of the vehicle itself."""
    free = FreeSpace(C)
    blind = scan(np.full(180, np.nan))
    for _ in range(2):
        free.update(see(blind, state(x=x, y=y), BeamTable(), C))
        free.forget()
    free.update(see(blind, state(x=x, y=y), BeamTable(), C))
    return free


def permitted(start: Start, candidates, free: FreeSpace) -> np.ndarray:
    """Which candidates pass the yardstick of braking."""
    sight, view = Sight(C), View(free, NONE, 0.0)
    brake = sight.hidden(tubes(start, np.zeros((1, 3)), C), view)
    return brake.permits(sight.hidden(tubes(start, np.asarray(candidates, dtype=float), C), view, brake))


def moving(vx: float, vy: float, x: float = 0.05, y: float = 0.05) -> Start:
    return Start(np.array([(x, y, 2.0)] * 2), np.array([(vx, vy, 0.0)] * 2))


def test_deep_in_the_unseen_no_command_leads_deeper_than_braking():
    """Braking ends with the whole hull in the unseen: all counts are at their most there, further in they are no more."""
    free, start = engaged_without_sight(), moving(1.2, 0.0)
    passed = permitted(start, [(0.0, 0.0, 0.0), (1.2, 0.0, 0.0), (1.2, 0.4, 0.0), (0.9, -0.9, 0.0)], free)
    assert passed.tolist() == [True, False, False, False]


@given(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2), st.floats(-1.2, 1.2), st.floats(-1.2, 1.2))
@settings(max_examples=60, deadline=None)
def test_what_passes_brings_the_hull_nowhere_where_braking_does_not(vx, vy, ux, uy):
    """Worked out with the hull's circle, no grid: what the grid adds is three cells at most."""
    start, free = moving(vx, vy), engaged_without_sight()
    if not permitted(start, [(ux, uy, 0.0)], free)[0]:
        return
    both = tubes(start, np.array([(ux, uy, 0.0), (0.0, 0.0, 0.0)]), C)
    end, (begin, stop) = both.stop_m[0, 0, :2], (both.turn_m[0, 1, :2], both.stop_m[0, 1, :2])
    way = stop - begin
    share = np.clip((end - begin) @ way / max(way @ way, 1e-12), 0.0, 1.0)
    beside = np.hypot(*(end - begin - share * way))
    assert min(beside, np.hypot(*(end - 0.05))) <= 3.0 * CELL_M


def test_spared_cells_do_not_count_and_may_lie_outside_the_window():
    free, here = engaged_without_sight(), np.array([(0.65,), (0.05,)])
    all_of_them = free.unseen(here, NONE, 0.0, wide=False)[0]
    spared = [free.unseen(here, NONE, 0.0, False, np.array([(place,), (0.05,)]))[0] for place in (0.65, 0.95, 5.0, -5.0)]
    assert spared[0] == 0
    assert 0 < spared[1] < all_of_them
    assert spared[2:] == [all_of_them, all_of_them]


def flown_backwards(stand_until_s: float, memory_s: float = MEMORY_S) -> tuple[Plant, float]:
    """Engaged facing +x, turned round, waited, then told to fly towards +x for good; the plant, and the place it began from."""
    safety, plant = SafetyFilter(config(memory_s=memory_s)), Plant(x=15.0)
    while plant.time_s < stand_until_s + 5.0:
        wanted = command(1.0)
        if plant.time_s < stand_until_s:
            wanted = command(yaw_rate=1.0 if plant.time_s < math.pi else 0.0)
        sent, verdict = safety.apply(wanted, plant.estimate(), plant.scan(), plant.time_s)
        assert verdict.fault is None
        plant.fly(sent)
    return plant, 15.0


@pytest.mark.parametrize("stand_until_s", [4.2, 4.5, 5.0])
def test_memory_that_runs_out_is_not_run_after(stand_until_s):
    """What lies behind is forgotten while it flies there: it stays where what is known around it reaches."""
    plant, begin = flown_backwards(stand_until_s)
    assert begin - 0.05 < plant.x < begin + 0.35


def test_fresh_memory_is_flown_into():
    plant, begin = flown_backwards(math.pi, memory_s=20.0)
    assert plant.x > begin + 1.0


@pytest.mark.parametrize(("distance", "speed", "wanted"), [(1.0625, 0.375, 0.8), (1.0294, 0.3333, 0.74), (1.0204, 0.3065, 0.689)])
def test_a_wall_out_of_reach_still_explains_the_unseen_behind_its_face(distance, speed, wanted):
    """Too far for any tube of this tick, near enough for the cells behind it: no reason to stop."""
    walls = np.array([(15.0 + distance, -3.0, 16.0 + distance, 3.0)])
    blank = scan()
    bearings = blank.angle_min_rad + blank.angle_increment_rad * np.arange(180)
    seen = scan(cast(walls, 15.0, 0.0, bearings))
    safety = SafetyFilter(config(max_acceleration_m_s2=1000.0, max_jerk_m_s3=1000.0))
    sent, verdict = safety.apply(command(wanted), state(x=15.0, v=(speed, 0.0, 0.0)), seen, 0.0)
    assert sent.velocity.x == wanted
    assert verdict.interventions == ()
