"""`--shadow`: the pilot flies, the stack runs and is logged, and the vehicle receives nothing. `--tether`: less of everything."""

from __future__ import annotations

import csv
import json
import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from air import Air, open_air, quiet
from hypothesis import given, settings
from hypothesis import strategies as st
from stand import ROOT

from flight.errors import ExitCode, MissionError, RefusedError
from flight.mission import Mission, TetherSection, goal_problem, load_mission
from flight.preparation import Place
from flight.results import FlightResult
from flight.session import FlightSession
from flight.tether import tethered
from safety.frames import CorridorVector

QUICK_TAKEOFF = {"COM_SPOOLUP_TIME": 0.0, "MPC_TKO_RAMP_T": 0.2, "COM_DISARM_LAND": 0.3, "MPC_LAND_SPEED": 1.0}


@pytest.fixture(scope="module")
def air(tmp_path_factory: pytest.TempPathFactory, seeker_policy: Path) -> Iterator[Air]:
    with open_air(tmp_path_factory.mktemp("air"), seeker_policy, QUICK_TAKEOFF) as air:
        air.link.close()  # the session under test opens its own
        air.lidar.close()
        yield air


class Pilot:
    """Takes off with sticks, flies ahead, lands with the land mode. All by radio; `fly` is not asked."""

    def __init__(self, air: Air) -> None:
        self.air = air
        self._axes: dict[str, float] = {}
        self._stop = threading.Event()
        self.error: BaseException | None = None

    def fly(self, begin: threading.Event) -> None:
        try:
            begin.wait(30.0)
            sticks = threading.Thread(target=self._send_sticks, daemon=True)
            sticks.start()
            self._flight()
        except BaseException as error:  # noqa: BLE001  (looked at by the test)
            self.error = error
        finally:
            self._stop.set()

    def _send_sticks(self) -> None:
        while not self._stop.wait(0.04):
            self.air.station.sticks(**self._axes)

    def _flight(self) -> None:
        air = self.air
        time.sleep(0.3)
        air.station.mode(3)
        air.wait(lambda: air.autopilot.mode.px4_name == "POSCTL")
        air.station.command(400, 1)
        air.wait(lambda: air.autopilot.armed)
        self._axes = {"up": 0.8}
        air.wait(lambda: air.gateway.vehicle.simulation.truth.position_m[2] > 1.1)
        self._axes = {"ahead": 0.28}  # beyond the dead zone, bent by the expo: 0.8 m/s
        air.wait(lambda: air.gateway.vehicle.simulation.truth.position_m[0] > 3.0)
        self._axes = {}
        time.sleep(0.5)
        air.station.mode(4, 6)
        air.wait(lambda: not air.autopilot.armed, 20.0)


@pytest.fixture(scope="module")
def shadowed(air: Air, tmp_path_factory: pytest.TempPathFactory) -> tuple[FlightResult, Path, Air]:
    status, interrupt = quiet()
    folder = tmp_path_factory.mktemp("shadow")
    session = FlightSession(air.mission, folder, status, interrupt, shadow=True)
    begin, pilot = threading.Event(), Pilot(air)
    waiting = status.phase

    def phase(text: str) -> None:
        waiting(text)
        if text.startswith("shadow: take off"):
            begin.set()

    status.phase = phase  # type: ignore[method-assign]
    thread = threading.Thread(target=pilot.fly, args=(begin,), daemon=True)
    thread.start()
    before = len(air.received())
    result = session.run()
    thread.join(30.0)
    assert pilot.error is None, pilot.error
    assert len(air.received()) == before
    return result, folder, air


@pytest.mark.realtime
def test_the_vehicle_receives_nothing_from_a_shadow(shadowed: tuple[FlightResult, Path, Air]) -> None:
    """Counted on the vehicle's side of the wire: no setpoint, no mode, no arming, no parameter of `fly`'s."""
    result, _, air = shadowed
    assert air.received() == []
    assert result.summary["setpoints_sent"] == 0
    kinds = {name for name, system, _ in air.gateway.server.wire_log.counts if system == 245}
    assert not any(name.startswith("SET_") for name in kinds), kinds
    assert "PARAM_SET" not in kinds
    assert {"HEARTBEAT", "COMMAND_LONG"} <= kinds  # it was connected, and asked for stream rates


@pytest.mark.realtime
def test_a_shadow_flight_is_logged_like_a_flight(shadowed: tuple[FlightResult, Path, Air]) -> None:
    result, folder, _ = shadowed
    assert result.outcome == "shadow"
    assert result.exit_code is ExitCode.GOAL_REACHED
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    assert summary["shadow"] is True
    assert summary["landed"] is True
    assert summary["loop"]["ticks"] > 40
    with (folder / "trajectory.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) >= summary["loop"]["ticks"] - 1
    assert max(float(row["x_m"]) for row in rows if row["x_m"]) > 2.5
    wished = [math.hypot(float(row["wanted_vx_m_s"]), float(row["wanted_vy_m_s"])) for row in rows if row["wanted_vx_m_s"]]
    assert max(wished) > 0.5  # the policy wanted to fly to the goal, and only the record knows


# ---- tether


@pytest.fixture(scope="module")
def corridor() -> Mission:
    return load_mission(ROOT / "configs" / "corridor.yaml")


def test_tether_reduces_speed_height_distance_and_time(corridor: Mission) -> None:
    place = Place((4.0, 0.5), 0.0, CorridorVector(31.0, 1.0, 2.0))
    reduced, new_place, notes = tethered(corridor, place)
    safety = reduced.safety
    assert safety.max_horizontal_speed_m_s == 0.4
    assert safety.max_vertical_speed_m_s == 0.3
    assert safety.max_yaw_rate_rad_s == 0.5
    assert safety.fence.high_m[2] == 2.0
    assert (safety.fence.low_m[0], safety.fence.high_m[0]) == (1.0, 7.0)
    assert reduced.timeouts.flight_s == 60.0
    assert reduced.takeoff_height_m < 2.0
    assert new_place.goal.x < 7.0
    assert goal_problem(new_place.goal, safety) is None
    assert any("goal drawn back" in note for note in notes)


def test_a_goal_inside_stays(corridor: Mission) -> None:
    goal = CorridorVector(5.5, 0.5, 1.5)
    assert tethered(corridor, Place((4.0, 0.5), 0.0, goal))[1].goal == goal


@settings(max_examples=60, deadline=None)
@given(
    st.floats(0.1, 5.0), st.floats(0.1, 2.0), st.floats(0.6, 20.0), st.floats(1.0, 60.0),
    st.floats(0.5, 34.0), st.floats(-3.0, 3.0), st.floats(0.8, 3.7),
)  # fmt: skip
def test_tether_only_ever_reduces(
    corridor: Mission, speed: float, climb: float, height: float, reach: float, x: float, y: float, z: float
) -> None:
    section = TetherSection(
        max_horizontal_speed_m_s=speed, max_vertical_speed_m_s=climb, max_height_m=height, max_distance_m=reach
    )
    mission = corridor.model_copy(update={"tether": section})
    try:
        reduced, place, _ = tethered(mission, Place((4.0, 0.0), 0.0, CorridorVector(x, y, z)))
    except RefusedError:
        return
    before, after = mission.safety, reduced.safety
    assert after.max_horizontal_speed_m_s <= min(before.max_horizontal_speed_m_s, speed)
    assert after.max_vertical_speed_m_s <= min(before.max_vertical_speed_m_s, climb)
    assert all(a >= b for a, b in zip(after.fence.low_m, before.fence.low_m, strict=True))
    assert all(a <= b for a, b in zip(after.fence.high_m, before.fence.high_m, strict=True))
    assert after.fence.high_m[2] <= height
    assert goal_problem(place.goal, after) is None
    assert reduced.takeoff_height_m <= mission.takeoff_height_m


def test_a_tether_without_room_is_refused(corridor: Mission) -> None:
    mission = corridor.model_copy(update={"tether": TetherSection(max_height_m=0.6)})
    with pytest.raises(RefusedError, match="tether"):
        tethered(mission, Place((4.0, 0.0), 0.0, CorridorVector(31.0, 0.0, 2.0)))


def test_a_tether_section_is_read_strictly(tmp_path: Path) -> None:
    text = (ROOT / "configs" / "corridor.yaml").read_text()
    path = tmp_path / "mission.yaml"
    path.write_text(text + "\ntether: {max_height_m: 1.5}\n")
    assert load_mission(path).tether.max_height_m == 1.5
    path.write_text(text + "\ntether: {max_heigth_m: 1.5}\n")
    with pytest.raises(MissionError, match="max_heigth_m"):
        load_mission(path)
