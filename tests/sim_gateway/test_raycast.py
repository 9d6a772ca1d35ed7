import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_gateway.collision import clearance_m
from sim_gateway.lidar import LidarConfig
from sim_gateway.raycast import beam_table, cast_beams, cast_rays, cast_rays_numpy

RANGE_MAX = 4.0
BEARINGS = LidarConfig().bearings_rad


def rotation(roll, pitch, yaw):
    """Body FLU to world; pitch positive turns the nose down (right-handed about the left axis)."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return rz @ ry @ rx


coordinate = st.integers(-5000, 5000).map(lambda v: v / 1000.0)
extent = st.integers(0, 3000).map(lambda v: v / 1000.0)
tilt = st.sampled_from([0.0, 0.0, 0.2, -0.45]) | st.floats(-0.7, 0.7)
heading = st.sampled_from([0.0, math.pi / 2, math.pi, -math.pi / 4]) | st.floats(-math.pi, math.pi)


@st.composite
def box(draw):
    low = [draw(coordinate) for _ in range(3)]
    return low + [v + draw(extent) for v in low]


scenes = st.fixed_dictionaries(
    {
        "boxes": st.lists(box(), max_size=8).map(lambda rows: np.array(rows, dtype=float).reshape(-1, 6)),
        "origin": st.tuples(coordinate, coordinate, extent).map(np.array),
        "turn": st.tuples(tilt, tilt, heading).map(lambda a: rotation(*a)),
        "range_max": st.sampled_from([0.5, 4.0, 12.0]),
    }
)
bearings = st.sampled_from([BEARINGS, LidarConfig.device().bearings_rad, np.array([0.0, math.pi / 2, -math.pi / 2, math.pi])])


@settings(max_examples=200, deadline=None)
@given(scene=scenes, beams=bearings)
def test_the_compiled_caster_agrees_with_its_numpy_twin(scene, beams):
    arguments = (scene["boxes"], scene["origin"], scene["turn"], beams, scene["range_max"])
    np.testing.assert_allclose(cast_rays(*arguments), cast_rays_numpy(*arguments), atol=1e-5, rtol=0.0)


@settings(max_examples=100, deadline=None)
@given(scene=scenes)
def test_a_hit_lies_on_a_surface_and_nothing_stands_before_it(scene):
    beams = BEARINGS[::20]
    ranges = cast_rays(scene["boxes"], scene["origin"], scene["turn"], beams, scene["range_max"])
    directions = scene["turn"][:, :2] @ beam_table(beams)
    for k, reach in enumerate(ranges):
        end = scene["origin"] + reach * directions[:, k]
        if reach < scene["range_max"] - 1e-9:
            assert min(clearance_m(scene["boxes"], end, 0.0), end[2]) < 1e-6
        for share in np.linspace(0.0, 1.0, 40, endpoint=False) if reach > 0.0 else []:  # 0: the origin is inside
            point = scene["origin"] + share * reach * directions[:, k]
            assert clearance_m(scene["boxes"], point, 0.0) > -1e-6


@settings(max_examples=50, deadline=None)
@given(scene=scenes)
def test_every_range_is_finite_and_within_limits(scene):
    ranges = cast_rays(scene["boxes"], scene["origin"], scene["turn"], BEARINGS, scene["range_max"])
    assert ranges.shape == BEARINGS.shape
    assert (ranges >= 0.0).all()
    assert (ranges <= scene["range_max"]).all()


WALL_AHEAD = np.array([[3.0, -10.0, 0.0, 3.2, 10.0, 10.0]])
HOVER = np.array([0.0, 0.0, 2.0])


@pytest.mark.parametrize("cast", [cast_rays, cast_rays_numpy])
class TestKnownScenes:
    def test_a_wall_ahead_reads_distance_over_cosine(self, cast):
        ranges = cast(WALL_AHEAD, HOVER, np.eye(3), np.array([0.0, 0.5, -0.5, 1.5]), RANGE_MAX)
        np.testing.assert_allclose(ranges, [3.0, 3.0 / math.cos(0.5), 3.0 / math.cos(0.5), RANGE_MAX], atol=1e-7)

    def test_positive_bearings_look_left(self, cast):
        left = np.array([[-0.5, 1.0, 0.0, 0.5, 1.5, 5.0]])
        ranges = cast(left, HOVER, np.eye(3), np.array([math.pi / 2, -math.pi / 2]), RANGE_MAX)
        np.testing.assert_allclose(ranges, [1.0, RANGE_MAX], atol=1e-7)

    def test_positive_yaw_turns_the_scan_left(self, cast):
        left = np.array([[-0.5, 1.0, 0.0, 0.5, 1.5, 5.0]])
        assert cast(left, HOVER, rotation(0, 0, math.pi / 2), np.array([0.0]), RANGE_MAX)[0] == pytest.approx(1.0)

    def test_nose_down_sees_the_floor_ahead(self, cast):
        ranges = cast(np.empty((0, 6)), np.array([0.0, 0.0, 0.5]), rotation(0, 0.3, 0), np.array([0.0, math.pi / 2]), RANGE_MAX)
        np.testing.assert_allclose(ranges, [0.5 / math.sin(0.3), RANGE_MAX], atol=1e-7)

    def test_nose_up_looks_over_a_low_box(self, cast):
        low = np.array([[2.0, -1.0, 0.0, 3.0, 1.0, 2.2]])
        assert cast(low, HOVER, np.eye(3), np.array([0.0]), RANGE_MAX)[0] == pytest.approx(2.0)
        assert cast(low, HOVER, rotation(0, -0.3, 0), np.array([0.0]), RANGE_MAX)[0] == RANGE_MAX

    def test_inside_a_box_every_beam_reads_zero(self, cast):
        around = np.array([[-1.0, -1.0, 0.0, 1.0, 1.0, 4.0]])
        assert (cast(around, HOVER, rotation(0.1, 0.2, 0.3), BEARINGS, RANGE_MAX) == 0.0).all()

    def test_a_box_just_out_of_range_is_not_seen(self, cast):
        assert cast(WALL_AHEAD, HOVER, np.eye(3), np.array([0.0]), 2.999)[0] == 2.999
        assert cast(WALL_AHEAD, HOVER, np.eye(3), np.array([0.0]), 3.001)[0] == pytest.approx(3.0)

    @pytest.mark.parametrize("side", [1.0, -1.0])
    def test_a_ray_within_a_face_counts_and_one_beside_it_does_not(self, cast, side):
        beside = np.array([[1.0, min(side, 0.0), 0.0, 2.0, max(side, 0.0), 5.0]])
        assert cast(beside, HOVER, np.eye(3), np.array([0.0]), RANGE_MAX)[0] == pytest.approx(1.0)
        assert cast(beside, HOVER - [0, side * 1e-6, 0], np.eye(3), np.array([0.0]), RANGE_MAX)[0] == RANGE_MAX

    def test_on_the_ground_and_level_the_floor_is_not_seen(self, cast):
        assert (cast(np.empty((0, 6)), np.zeros(3), np.eye(3), BEARINGS, RANGE_MAX) == RANGE_MAX).all()


def test_rows_beyond_the_count_are_ignored():
    padded = np.vstack([WALL_AHEAD, [[0.5, -1.0, 0.0, 0.6, 1.0, 5.0]]])
    out = np.empty(1)
    cast_beams(padded, 1, HOVER, np.eye(3), beam_table(np.array([0.0])), RANGE_MAX, out)
    assert out[0] == pytest.approx(3.0)
