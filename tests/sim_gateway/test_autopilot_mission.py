"""Missions: uploaded, read back, flown item by item, paused, cleared."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import development as mav

from sim_gateway.conformance.bench import Bench
from sim_gateway.flight_modes import FlightMode

Item = tuple[int, float, float, float, tuple[float, ...]]
NAN = math.nan
FLIGHT: list[Item] = [
    (mav.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 4.0, (0, 0, 0, NAN)),
    (mav.MAV_CMD_DO_CHANGE_SPEED, 0.0, 0.0, 0.0, (1, 3.0, -1, 0)),
    (mav.MAV_CMD_NAV_WAYPOINT, 12.0, 0.0, 4.0, (0, 1.0, 0, NAN)),
    (mav.MAV_CMD_NAV_WAYPOINT, 12.0, 8.0, 5.0, (2.0, 1.0, 0, NAN)),
    (mav.MAV_CMD_NAV_LAND, 12.0, 8.0, 0.0, (0, 0, 0, NAN)),
]


def upload(bench: Bench, items: list[Item]) -> int:
    """Type of the acknowledgement."""
    since_s = bench.time_s
    bench.onboard.send(mav.MAVLink_mission_count_message(1, 1, len(items), 0))
    for _ in range(len(items)):
        asked = bench.run(0.04).named("MISSION_REQUEST_INT", since_s)[-1][1]
        command, north, east, height, params = items[asked.seq]
        latitude, longitude, _ = bench.vehicle.frame.to_global((north, east, 0.0))
        place = (round(latitude * 1e7), round(longitude * 1e7), height)
        message = mav.MAVLink_mission_item_int_message(1, 1, asked.seq, 6, command, 0, 1, *params, *place, 0)
        bench.onboard.send(message)
    return int(bench.run(0.1).named("MISSION_ACK", since_s)[-1][1].type)


def start(bench: Bench) -> None:
    bench.command(mav.MAV_CMD_DO_SET_MODE, 1, 4, 4).run(0.1)
    bench.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1).run(0.1)


def test_flies_takeoff_waypoints_and_landing() -> None:
    bench = Bench()
    assert upload(bench, FLIGHT) == mav.MAV_MISSION_ACCEPTED
    start(bench)
    assert bench.mode == "AUTO.MISSION"
    corner = False
    while bench.pilot.armed and bench.time_s < 90.0:
        bench.run(0.2)
        north, east, down = bench.pilot.state.position
        corner = corner or math.dist((north, east, down), (12.0, 0.0, -4.0)) < 1.5
    assert corner
    assert not bench.pilot.armed
    assert math.dist(bench.pilot.state.position[:2], (12.0, 8.0)) < 1.0
    assert [m.seq for _, m in bench.named("MISSION_ITEM_REACHED")] == [0, 1, 2, 3]
    assert bench.texts(0.0)[-1][2] == "Disarmed by landing"


def test_reads_back_what_was_uploaded_and_clears_it() -> None:
    bench = Bench()
    upload(bench, FLIGHT)
    bench.onboard.send(mav.MAVLink_mission_request_list_message(1, 1, 0))
    assert bench.run(0.1).named("MISSION_COUNT")[-1][1].count == len(FLIGHT)
    bench.onboard.send(mav.MAVLink_mission_request_int_message(1, 1, 3, 0))
    item = bench.run(0.1).named("MISSION_ITEM_INT")[-1][1]
    assert (item.command, item.z, item.param1, item.frame) == (mav.MAV_CMD_NAV_WAYPOINT, 5.0, 2.0, 6)
    bench.onboard.send(mav.MAVLink_mission_clear_all_message(1, 1, 0))
    assert bench.run(0.1).pilot.mission.legs == ()


def test_hold_pauses_and_the_mission_goes_on_from_the_current_item() -> None:
    bench = Bench()
    upload(bench, FLIGHT[:3])
    start(bench)
    bench.run(30.0, until=lambda: bench.pilot.mission.current == 2)
    bench.pilot.set_mode(FlightMode.LOITER)
    bench.run(3.0)
    state = bench.telemetry.build("MISSION_CURRENT")
    assert (state.seq, state.total, state.mission_state) == (2, 3, mav.MISSION_STATE_PAUSED)
    bench.pilot.set_mode(FlightMode.MISSION)
    bench.run(30.0, until=lambda: bench.mode == "AUTO.LOITER")
    assert bench.pilot.mission.complete
    assert math.dist(bench.run(4.0).pilot.state.position[:2], (12.0, 0.0)) < 0.5


def test_current_item_can_be_chosen() -> None:
    bench = Bench(5.0)
    upload(bench, FLIGHT)
    bench.onboard.send(mav.MAVLink_mission_set_current_message(1, 1, 3))
    assert bench.run(0.1).named("MISSION_CURRENT")[-1][1].seq == 3
    bench.onboard.send(mav.MAVLink_mission_set_current_message(1, 1, 9))
    assert bench.run(0.1).pilot.mission.current == 3
    bench.command(mav.MAV_CMD_DO_SET_MISSION_CURRENT, 1).run(0.1)
    assert bench.pilot.mission.current == 1


def test_no_mission_in_the_air_is_refused() -> None:
    bench = Bench(5.0)
    bench.command(mav.MAV_CMD_MISSION_START).run(0.1)
    assert bench.acks(mav.MAV_CMD_MISSION_START, 0.0) == ["TEMPORARILY_REJECTED"]


def test_a_return_needs_no_place_and_no_height() -> None:
    """As MAVSDK uploads "return after the mission"."""
    bench = Bench()
    bench.onboard.send(mav.MAVLink_mission_count_message(1, 1, 2, 0))
    latitude, longitude, _ = bench.vehicle.frame.to_global((6.0, 0.0, 0.0))
    waypoint = (6, mav.MAV_CMD_NAV_WAYPOINT, 0, 1, 0, 1.0, 0, NAN, round(latitude * 1e7), round(longitude * 1e7), 4.0)
    back = (2, mav.MAV_CMD_NAV_RETURN_TO_LAUNCH, 0, 1, NAN, NAN, NAN, NAN, 2**31 - 1, 2**31 - 1, NAN)
    for number, item in enumerate((waypoint, back)):
        bench.run(0.04).onboard.send(mav.MAVLink_mission_item_int_message(1, 1, number, *item, 0))
    assert bench.run(0.1).named("MISSION_ACK")[-1][1].type == mav.MAV_MISSION_ACCEPTED
    start(bench)
    bench.run(30.0, until=lambda: bench.mode == "AUTO.RTL")
    assert bench.mode == "AUTO.RTL"
    bench.run(0.2)
    assert [m.seq for _, m in bench.named("MISSION_ITEM_REACHED")] == [0, 1]  # by the last one MAVSDK knows that it is done
    assert bench.telemetry.build("MISSION_CURRENT").mission_state == mav.MISSION_STATE_COMPLETE
    bench.run(60.0, until=lambda: not bench.pilot.armed)
    assert not bench.pilot.armed
    assert math.hypot(*bench.pilot.state.position[:2]) < 0.5


def test_rally_points_are_kept_apart_from_the_mission() -> None:
    bench = Bench()
    upload(bench, FLIGHT)
    bench.onboard.send(mav.MAVLink_mission_count_message(1, 1, 1, mav.MAV_MISSION_TYPE_RALLY))
    place = (bench.vehicle.frame.to_global((5.0, 5.0, 0.0))[:2], 10.0)
    point = (round(place[0][0] * 1e7), round(place[0][1] * 1e7), place[1])
    item = (0, 6, mav.MAV_CMD_NAV_RALLY_POINT, 0, 1, 0, 0, 0, 0, *point, mav.MAV_MISSION_TYPE_RALLY)
    bench.run(0.04).onboard.send(mav.MAVLink_mission_item_int_message(1, 1, *item))
    ack = bench.run(0.1).named("MISSION_ACK")[-1][1]
    assert (ack.type, ack.mission_type) == (mav.MAV_MISSION_ACCEPTED, mav.MAV_MISSION_TYPE_RALLY)
    for kind, count in ((0, len(FLIGHT)), (mav.MAV_MISSION_TYPE_RALLY, 1)):
        bench.onboard.send(mav.MAVLink_mission_request_list_message(1, 1, kind))
        assert bench.run(0.1).named("MISSION_COUNT")[-1][1].count == count
    bench.onboard.send(mav.MAVLink_mission_clear_all_message(1, 1, mav.MAV_MISSION_TYPE_ALL))
    acks = [m for _, m in bench.run(0.1).named("MISSION_ACK", bench.time_s - 0.11)]
    assert [(m.type, m.mission_type) for m in acks] == [(mav.MAV_MISSION_ACCEPTED, mav.MAV_MISSION_TYPE_ALL)]
    bench.onboard.send(mav.MAVLink_mission_request_list_message(1, 1, 0))
    assert bench.run(0.1).named("MISSION_COUNT")[-1][1].count == 0


def test_a_lost_item_is_asked_for_again_on_the_link_of_the_upload() -> None:
    bench = Bench()
    bench.onboard.send(mav.MAVLink_mission_count_message(1, 1, 2, 0))
    bench.run(1.0)
    assert 3 <= len(bench.named("MISSION_REQUEST_INT")) <= 6
    assert bench.named("MISSION_REQUEST_INT", client=bench.ground) == []
