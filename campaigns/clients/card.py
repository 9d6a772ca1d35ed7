"""A flight card for MAVSDK in Python: what a user's programs ask of a vehicle, each verb with a deadline and a check.

Runs in the client's own interpreter, so it needs nothing but the standard library. MAVSDK 4 and the gRPC wrapper have the same
plugins and setpoints, but for telemetry: `Drone` hides that.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass
from types import SimpleNamespace
from typing import Any, Protocol

VERB_DEADLINE_S = 60.0
_NAN = math.nan
_EARTH_RADIUS_M = 6371000.0


class Drone(Protocol):
    """A connected vehicle. The plugins are those of MAVSDK; `types` are its setpoints, mission items and fences by name."""

    action: Any
    offboard: Any
    param: Any
    mission: Any
    geofence: Any
    log_files: Any
    types: SimpleNamespace

    async def read(self, name: str) -> Any:
        """The newest value of that name in the telemetry plugin."""

    async def progress(self) -> Any:
        """MissionProgress."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What one verb showed."""

    verb: str
    ok: bool
    seen: str
    seconds: float


Verb = Callable[[Drone], Awaitable[str]]


async def until(read: Callable[[], Awaitable[Any]], wanted: Callable[[Any], bool], within_s: float = 8.0) -> Any:
    """The first value that is wanted. Raises `AssertionError` with the last one."""
    end = time.monotonic() + within_s
    while True:
        value = await read()
        if wanted(value):
            return value
        assert time.monotonic() < end, f"after {within_s:g} s still {value}"
        await asyncio.sleep(0.05)


async def _mode(drone: Drone, name: str, within_s: float = 8.0) -> None:
    await until(lambda: drone.read("flight_mode"), lambda mode: mode.name == name, within_s)


async def _velocity(drone: Drone) -> Any:
    return (await drone.read("position_velocity_ned")).velocity


async def _place(drone: Drone) -> tuple[float, float, float]:
    position = (await drone.read("position_velocity_ned")).position
    return position.north_m, position.east_m, position.down_m


def _near(place: tuple[float, float, float], within_m: float = 0.6) -> Callable[[tuple[float, float, float]], bool]:
    return lambda here: math.dist(here, place) < within_m


async def _global_offset(drone: Drone, north_m: float, east_m: float) -> tuple[float, float]:
    """Latitude and longitude that far from home."""
    home = await drone.read("home")
    latitude = home.latitude_deg + math.degrees(north_m / _EARTH_RADIUS_M)
    return latitude, home.longitude_deg + math.degrees(east_m / _EARTH_RADIUS_M / math.cos(math.radians(latitude)))


async def _hover(drone: Drone) -> None:
    await drone.offboard.set_velocity_ned(drone.types.VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    await until(lambda: _velocity(drone), lambda v: math.hypot(v.north_m_s, v.east_m_s) < 0.3)


# ---- verbs


async def health(drone: Drone) -> str:
    """Wait until the vehicle may be armed."""
    seen = await until(lambda: drone.read("health"), lambda h: h.is_global_position_ok and h.is_home_position_ok, 15.0)
    await until(lambda: drone.read("health_all_ok"), bool, 15.0)
    return f"global position, home, armable: {seen.is_armable}"


async def parameters(drone: Drone) -> str:
    """List all, write and read back a float and a whole number."""
    everything = await drone.param.get_all_params()
    count = len(everything.int_params) + len(everything.float_params)
    assert count >= 875, count
    await drone.param.set_param_float("MIS_TAKEOFF_ALT", 3.5)
    await drone.param.set_param_int("COM_OBL_RC_ACT", 5)
    height = await drone.param.get_param_float("MIS_TAKEOFF_ALT")
    assert height == 3.5, height
    assert await drone.param.get_param_int("COM_OBL_RC_ACT") == 5
    await drone.param.set_param_int("COM_OBL_RC_ACT", 0)
    return f"{count} listed, float and integer written and read back"


async def telemetry(drone: Drone) -> str:
    """One of everything a program reads."""
    names = ["position", "home", "attitude_euler", "attitude_quaternion", "velocity_ned", "battery", "gps_info", "odometry"]
    names += ("imu", "altitude", "heading", "landed_state", "unix_epoch_time", "scaled_pressure", "distance_sensor")
    values = {name: await asyncio.wait_for(drone.read(name), 5.0) for name in names}
    assert values["gps_info"].num_satellites >= 6
    assert values["battery"].voltage_v > 10.0
    assert abs(values["position"].latitude_deg - values["home"].latitude_deg) < 1e-4
    return f"{len(values)} streams"


async def takeoff(drone: Drone) -> str:
    """Arm, take off, reach Hold."""
    await drone.action.set_takeoff_altitude(3.0)
    await drone.action.arm()
    await drone.action.takeoff()
    await _mode(drone, "TAKEOFF")
    await _mode(drone, "HOLD", 15.0)
    assert await drone.read("in_air")
    height = (await drone.read("position")).relative_altitude_m
    assert height > 2.0, height
    return f"Hold at {height:.1f} m"


async def velocity_ned(drone: Drone) -> str:
    """OFFBOARD by the plugin, velocity in NED with a heading."""
    await drone.offboard.set_velocity_ned(drone.types.VelocityNedYaw(1.0, 0.0, 0.0, 90.0))
    await drone.offboard.start()
    await _mode(drone, "OFFBOARD")
    v = await until(lambda: _velocity(drone), lambda v: v.north_m_s > 0.7)
    heading = await until(lambda: drone.read("heading"), lambda h: abs(h.heading_deg - 90.0) < 10.0)
    return f"{v.north_m_s:.1f} m/s north of 1.0, heading {heading.heading_deg:.0f} of 90"


async def velocity_body(drone: Drone) -> str:
    """Velocity in the body frame, while heading east."""
    await drone.offboard.set_velocity_body(drone.types.VelocityBodyYawspeed(1.0, 0.0, 0.0, 0.0))
    v = await until(lambda: _velocity(drone), lambda v: v.east_m_s > 0.7 and abs(v.north_m_s) < 0.4)
    await _hover(drone)
    return f"forward 1.0 m/s: {v.east_m_s:.1f} m/s east"


async def position_ned(drone: Drone) -> str:
    """Position in NED."""
    north, east, down = await _place(drone)
    goal = (north + 3.0, east - 2.0, down - 1.0)
    await drone.offboard.set_position_ned(drone.types.PositionNedYaw(*goal, 0.0))
    here = await until(lambda: _place(drone), _near(goal), 12.0)
    return f"{math.dist(here, goal):.1f} m from it"


async def position_global(drone: Drone) -> str:
    """Position in latitude, longitude and height above home."""
    altitude_type = drone.types.PositionGlobalYaw.AltitudeType.REL_HOME
    latitude, longitude = await _global_offset(drone, 2.0, 2.0)
    await drone.offboard.set_position_global(drone.types.PositionGlobalYaw(latitude, longitude, 4.0, 0.0, altitude_type))
    here = await until(lambda: drone.read("position"), lambda p: _metres(p, latitude, longitude) < 0.7, 15.0)
    return f"{_metres(here, latitude, longitude):.1f} m from it, {here.relative_altitude_m:.1f} m up of 4.0"


def _metres(position: Any, latitude_deg: float, longitude_deg: float) -> float:
    north = math.radians(position.latitude_deg - latitude_deg) * _EARTH_RADIUS_M
    east = math.radians(position.longitude_deg - longitude_deg) * _EARTH_RADIUS_M * math.cos(math.radians(latitude_deg))
    return math.hypot(north, east)


async def position_velocity(drone: Drone) -> str:
    """Position with a velocity fed forward."""
    north, east, down = await _place(drone)
    goal = drone.types.PositionNedYaw(north + 3.0, east, down, 0.0)
    await drone.offboard.set_position_velocity_ned(goal, drone.types.VelocityNedYaw(0.3, 0.0, 0.0, 0.0))
    v = await until(lambda: _velocity(drone), lambda v: v.north_m_s > 0.5)
    return f"{v.north_m_s:.1f} m/s towards it"


async def acceleration(drone: Drone) -> str:
    """Acceleration alone."""
    await _hover(drone)
    await drone.offboard.set_acceleration_ned(drone.types.AccelerationNed(0.0, 1.0, 0.0))
    v = await until(lambda: _velocity(drone), lambda v: v.east_m_s > 0.8)
    await _hover(drone)
    return f"1 m/s2 east: {v.east_m_s:.1f} m/s east"


async def attitude(drone: Drone) -> str:
    """Attitude and thrust."""
    await drone.offboard.set_attitude(drone.types.Attitude(6.0, 0.0, 0.0, 0.5))
    angles = await until(lambda: drone.read("attitude_euler"), lambda a: abs(a.roll_deg - 6.0) < 1.5)
    await _hover(drone)
    return f"roll {angles.roll_deg:.0f} of 6 degrees"


async def attitude_rate(drone: Drone) -> str:
    """Body rates and thrust."""
    await drone.offboard.set_attitude_rate(drone.types.AttitudeRate(0.0, 0.0, 30.0, 0.5))
    heading = await until(lambda: drone.read("heading"), lambda h: 25.0 < h.heading_deg < 120.0)
    await _hover(drone)
    return f"30 degrees/s: heading {heading.heading_deg:.0f}"


async def offboard_stop(drone: Drone) -> str:
    """Leave OFFBOARD by the plugin."""
    await drone.offboard.stop()
    await _mode(drone, "HOLD")
    return "Hold"


async def geofence(drone: Drone) -> str:
    """Upload a fence, fly into it, be held, clear it."""
    kinds = drone.types
    corners = [await _global_offset(drone, north, east) for north, east in ((-6, -15), (14, -15), (14, 15), (-6, 15))]
    inside = kinds.Polygon([kinds.Point(*corner) for corner in corners], kinds.FenceType.INCLUSION)
    tower = kinds.Circle(kinds.Point(*await _global_offset(drone, 0.0, 40.0)), 5.0, kinds.FenceType.EXCLUSION)
    await drone.geofence.upload_geofence(kinds.GeofenceData([inside], [tower]))
    await drone.param.set_param_int("GF_ACTION", 2)
    await drone.offboard.set_velocity_ned(kinds.VelocityNedYaw(3.0, 0.0, 0.0, 0.0))
    await drone.offboard.start()
    await _mode(drone, "OFFBOARD")
    await _mode(drone, "HOLD", 20.0)
    north, _, _ = await _place(drone)
    assert 13.0 < north < 18.0, north
    await drone.geofence.clear_geofence()
    return f"held {north - 14.0:.1f} m behind the fence; cleared"


async def goto(drone: Drone) -> str:
    """Reposition by latitude, longitude and altitude."""
    home = await drone.read("home")
    latitude, longitude = await _global_offset(drone, 4.0, 4.0)
    await drone.action.goto_location(latitude, longitude, home.absolute_altitude_m + 5.0, 0.0)
    here = await until(lambda: drone.read("position"), lambda p: _metres(p, latitude, longitude) < 1.0, 25.0)
    return f"{_metres(here, latitude, longitude):.1f} m from it"


async def return_to_launch(drone: Drone) -> str:
    """Return, land, disarm."""
    await drone.action.return_to_launch()
    await _mode(drone, "RETURN_TO_LAUNCH")
    await until(lambda: drone.read("armed"), lambda armed: not armed, 45.0)
    north, east, _ = await _place(drone)
    assert math.hypot(north, east) < 1.5, (north, east)
    return f"landed and disarmed {math.hypot(north, east):.1f} m from home"


async def mission(drone: Drone) -> str:
    """Upload, read back, fly from the ground, return after it."""
    kinds = drone.types
    items = [_waypoint(kinds, *await _global_offset(drone, *place)) for place in ((6.0, 0.0), (6.0, 5.0))]
    await drone.mission.set_return_to_launch_after_mission(True)
    await drone.mission.upload_mission(kinds.MissionPlan(items))
    stored = (await drone.mission.download_mission()).mission_items
    assert len(stored) >= len(items), len(stored)
    await drone.action.arm()
    await drone.mission.start_mission()
    await _mode(drone, "MISSION")
    progress = await until(drone.progress, lambda p: p.total > 0 and p.current == p.total, 40.0)
    await _mode(drone, "RETURN_TO_LAUNCH")
    return f"{progress.current} of {progress.total} items, then home"


def _waypoint(kinds: SimpleNamespace, latitude: float, longitude: float) -> Any:
    item = kinds.MissionItem
    camera, vehicle = item.CameraAction.NONE, item.VehicleAction.NONE
    return item(latitude, longitude, 4.0, 4.0, True, _NAN, _NAN, camera, _NAN, 1.0, 1.0, _NAN, _NAN, vehicle)


async def land(drone: Drone) -> str:
    """Land here, be disarmed."""
    await drone.action.land()
    await _mode(drone, "LAND")
    await until(lambda: drone.read("armed"), lambda armed: not armed, 30.0)
    return "landed and disarmed"


async def log_list(drone: Drone) -> str:
    """The vehicle's log files."""
    entries = await drone.log_files.get_entries()
    assert entries
    return f"{len(entries)} listed"


OFFBOARD: dict[str, Verb] = {
    "offboard: velocity NED": velocity_ned,
    "offboard: velocity body": velocity_body,
    "offboard: position NED": position_ned,
    "offboard: position global": position_global,
    "offboard: position and velocity": position_velocity,
    "offboard: acceleration": acceleration,
    "offboard: attitude": attitude,
    "offboard: body rates": attitude_rate,
    "offboard: stop": offboard_stop,
}
VERBS: dict[str, Verb] = {
    "health": health,
    "parameters": parameters,
    "telemetry": telemetry,
    "takeoff": takeoff,
    **OFFBOARD,
    "geofence": geofence,
    "go to": goto,
    "return": return_to_launch,
    "mission": mission,
    "land": land,
    "log list": log_list,
}


async def perform(drone: Drone, verbs: dict[str, Verb]) -> list[dict[str, Any]]:
    """Every verb in turn; one that fails is told, and the next one tried."""
    shown = []
    for name, verb in verbs.items():
        started = time.monotonic()
        try:
            ok, seen = True, await asyncio.wait_for(verb(drone), VERB_DEADLINE_S)
        except Exception as error:  # noqa: BLE001  (whatever the client raises is what it saw)
            ok, seen = False, f"{type(error).__name__}: {error}"
        shown.append(asdict(Seen(name, ok, seen[:200], round(time.monotonic() - started, 1))))
    return shown
