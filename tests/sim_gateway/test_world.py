import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_gateway.corridor import generate_corridor
from sim_gateway.paths import path_exists
from sim_gateway.scene import Mover, World, place_movers
from sim_gateway.world import PaperConfig, load_world, paper_world
from strict_yaml import ConfigError

WORLDS = Path(__file__).parents[2] / "configs" / "worlds"

BOXES = """\
kind: boxes
seed: 3
boxes:
  start: [1, 0, 0]
  goal: [9, 0, 2]
  boxes:
    - {center: [5, 0, 5], size: [1, 2, 10]}
  movers:
    - {size: [0.5, 0.5, 10], x_m: 7, z_m: 5, y_m: [-1, 1], speed_m_s: 0.5}
"""


def write(folder, text):
    path = folder / "world.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_shipped_corridor_file_spells_out_the_defaults():
    world = load_world(WORLDS / "corridor.yaml")
    assert world.static_boxes.tobytes() == generate_corridor(1).static_boxes.tobytes()


def test_the_shipped_moving_corridor_moves():
    world = load_world(WORLDS / "corridor_moving.yaml")
    assert 1 <= len(world.movers) <= 4
    assert not np.array_equal(world.boxes_at(0.0), world.boxes_at(1.0))


def test_a_seed_argument_replaces_the_one_in_the_file():
    world = load_world(WORLDS / "corridor.yaml", seed=7)
    assert world.seed == 7
    assert world.static_boxes.tobytes() == generate_corridor(7).static_boxes.tobytes()


def test_the_paper_world_has_the_published_boxes():
    world = load_world(WORLDS / "paper.yaml")
    assert len(world.static_boxes) == 6
    np.testing.assert_allclose(world.static_boxes[0], [-0.575, 5.925, -0.25, 40.575, 6.075, 10.25])
    np.testing.assert_allclose(world.static_boxes[2], [4.9416, 0.7820, 0.0, 5.4416, 1.2820, 12.0])
    assert [mover.x_m for mover in world.movers] == [13.0, 20.0, 18.0, 27.0]
    assert world.goal == (30.0, 2.0, 7.0)


def test_raised_movers_span_the_flight_height_and_published_ones_do_not():
    assert all(paper_world().boxes_at(0.0)[6:, 5] == 10.0)
    published = paper_world(config=PaperConfig(raise_movers=False)).boxes_at(0.0)[6:, 5]
    np.testing.assert_allclose(published, [5.0, 4.0, 4.0, 2.0])


def test_movers_of_the_paper_world_can_stand_still():
    world = paper_world(config=PaperConfig(moving=False))
    assert world.movers == ()
    assert len(world.static_boxes) == 10


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), time_s=st.floats(0.0, 200.0))
def test_the_paper_world_always_leaves_a_way(seed, time_s):
    world = paper_world(seed)
    boxes = world.boxes_at(time_s)
    assert (boxes[:, 4] <= 6.08).all()
    assert path_exists(boxes, (*world.start[:2], 7.0), world.goal, 0.45)


def test_a_written_out_world_is_what_the_file_says(tmp_path):
    world = load_world(write(tmp_path, BOXES))
    np.testing.assert_allclose(world.boxes_at(0.0), [[4.5, -1, 0, 5.5, 1, 10], [6.75, -1.25, 0, 7.25, -0.75, 10]])
    np.testing.assert_allclose(world.boxes_at(2.0)[1], [6.75, -0.25, 0, 7.25, 0.25, 10])
    assert (world.start, world.goal) == ((1.0, 0.0, 0.0), (9.0, 0.0, 2.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("kind: tunnel\n", "kind"),
        ("kind: corridor\nsede: 3\n", "unknown key"),
        ("kind: corridor\npaper: {moving: true}\n", "needs kind: paper"),
        ("kind: boxes\n", "required with kind: boxes"),
        ("kind: corridor\nseed: -1\n", "seed"),
        ("kind: corridor\ncorridor: {length_m: .nan}\n", "finite"),
        ("kind: corridor\ncorridor: {pillars: [32, 32], pillar_x_m: [15, 17]}\n", "fewer or narrower"),
        ("kind: paper\npaper: {mover_speed_m_s: [0.5, 0.2]}\n", "mover_speed_m_s"),
        (BOXES.replace("goal: [9, 0, 2]", "goal: [5, 0, 2]"), "goal: .* lies inside a box"),
        (BOXES.replace("start: [1, 0, 0]", "start: [4.6, 0, 0]"), "start: .* lies inside a box"),
        (BOXES.replace("[-1, 1]", "[1, -1]"), "lower turning point"),
        (BOXES.replace("size: [1, 2, 10]", "size: [1, 0, 10]"), "size"),
    ],
)
def test_a_mistake_in_a_world_file_names_the_file_and_the_remedy(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message) as caught:
        load_world(write(tmp_path, text))
    assert "world.yaml" in str(caught.value)


def test_a_negative_seed_argument_is_refused():
    with pytest.raises(ConfigError, match="seed -1"):
        load_world(WORLDS / "corridor.yaml", seed=-1)


def test_boxes_turned_inside_out_are_refused():
    with pytest.raises(ValueError, match="min <= max"):
        World("w", 0, 1.0, 1.0, 1.0, np.array([[1.0, 0, 0, 0, 1, 1]]), (), (0, 0, 0), 0.0, (0, 0, 0))


def test_a_world_cannot_be_changed_by_accident():
    world = paper_world()
    with pytest.raises(ValueError, match="read-only"):
        world.static_boxes[0, 0] = 1.0


movers = st.builds(
    lambda low, span, speed, phase: Mover((0.5, 0.5, 10.0), 3.0, 5.0, low, low + span, speed, phase),
    st.floats(-3, 3),
    st.floats(0.0, 5.0),
    st.floats(0.0, 2.0),
    st.floats(0.0, 20.0),
)


@settings(max_examples=150, deadline=None)
@given(mover=movers, time_s=st.floats(0.0, 500.0), later_s=st.floats(0.0, 0.5))
def test_a_mover_stays_in_its_range_and_never_jumps(mover, time_s, later_s):
    before, after = (0.5 * (mover.box_at(t)[1] + mover.box_at(t)[4]) for t in (time_s, time_s + later_s))
    assert mover.y_low_m - 1e-9 <= before <= mover.y_high_m + 1e-9
    assert abs(after - before) <= mover.speed_m_s * later_s + 1e-6


def test_a_mover_comes_back_after_two_spans():
    mover = Mover((0.5, 0.5, 10.0), 3.0, 5.0, -1.0, 2.0, 0.5)
    period = 2.0 * 3.0 / 0.5
    np.testing.assert_allclose(mover.box_at(1.3), mover.box_at(1.3 + 5 * period), atol=1e-9)
    assert mover.box_at(period / 2)[1] == pytest.approx(2.0 - 0.25)


def test_placing_rows_leaves_padding_alone():
    rows = np.vstack([Mover((1.0, 1.0, 1.0), 0.0, 0.5, 0.0, 1.0, 1.0).as_row(), np.full(9, math.nan)])
    out = np.full((2, 6), -7.0)
    place_movers(rows, 1, 0.25, out)
    np.testing.assert_allclose(out[0], [-0.5, -0.25, 0.0, 0.5, 0.75, 1.0])
    assert (out[1] == -7.0).all()


def test_the_shipped_paper_data_is_whole():
    data = json.loads((Path(__file__).parents[2] / "sim_gateway" / "paper_world.json").read_text(encoding="utf-8"))
    assert {key: len(value) for key, value in data.items()} == {"walls": 2, "static_boxes": 4, "moving_boxes": 4}
