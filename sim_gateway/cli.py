"""The ``sim-gateway`` command."""

from __future__ import annotations

import logging
import math
import os
import sys
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sim_gateway.errors import UsageError

if TYPE_CHECKING:
    from sim_gateway.faults import Fault
    from sim_gateway.link_spec import LinkSpec
    from sim_gateway.scene import World

_EPILOG = """
Examples:

sim-gateway --world configs/worlds/corridor.yaml

sim-gateway --world configs/worlds/corridor.yaml --seed 7 --wind 1,0.5,0 --report runs/truth.json

sim-gateway --world configs/worlds/paper.yaml --onboard-port 14541 --lidar-port 10941 --gcs-port 0

sim-gateway --world configs/worlds/corridor.yaml --fault lidar_freeze@offboard:12+3 --fault battery@40:fraction=0.1

sim-gateway --world configs/worlds/corridor.yaml --dynamics jsbsim --vehicle sih_quadx

sim-gateway --world configs/worlds/corridor.yaml --vehicles 3

sim-gateway --world configs/worlds/corridor.yaml --serial-lidar ld06 --serial-link /tmp/lidar

sim-gateway --world configs/worlds/corridor.yaml --link udp:14540,delay_ms=50,loss=0.02 --link pty:/tmp/mavlink,baud=57600

sim-gateway --world configs/worlds/corridor.yaml --px4

sim-gateway --world configs/worlds/corridor.yaml --px4 serial:/dev/ttyACM0,921600

sim-gateway --world configs/worlds/corridor.yaml --follow udpin://127.0.0.1:14551 --heading 90

Then connect a MAVSDK client to udpin://127.0.0.1:14540 and a Hokuyo SCIP driver to 127.0.0.1:10940.
"""
_MOST_VEHICLES = 40  # then the onboard ports would meet the gateway's own
_PX4_DEFAULT = "tcp:4560"
_HIGHEST_PORT = 65535 - 4020 - _MOST_VEHICLES  # the gateway's own ports lie up to this far above the client's

app = typer.Typer(add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False)


class Dynamics(StrEnum):
    """What moves the vehicle."""

    internal = "internal"
    jsbsim = "jsbsim"


class Vehicle(StrEnum):
    """Profiles of vehicles, as in `vehicle_params.PROFILES`."""

    iris = "iris"
    sih_quadx = "sih_quadx"


class Estimate(StrEnum):
    """How far the vehicle's state estimate is from the truth."""

    nominal = "nominal"
    none = "none"
    px4_sih = "px4_sih"


class SerialKind(StrEnum):
    """Spinning LiDARs on a serial line."""

    ld06 = "ld06"
    stl27l = "stl27l"
    rplidar = "rplidar"


_Links = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KIND:PLACE,NAME=VALUE",
        help="A MAVLink link (udp, tcp, serial, pty), or how good the one on that UDP port is, such as "
        "udp:14540,delay_ms=50,jitter_ms=10,loss=0.02,dup=0.01 or pty:/tmp/mavlink,baud=57600; repeatable.",
    ),
]
_Px4 = Annotated[
    str | None,
    typer.Option(
        metavar="[tcp:PORT|serial:DEVICE,BAUD]",
        help="Be the simulator of a real PX4 (SITL: airframe 10016 none_iris; serial: HITL) instead. Alone: tcp:4560.",
    ),
]
_NoGps = Annotated[bool, typer.Option("--no-gps", help="With --px4: vision odometry instead of GPS.")]
_Follow = Annotated[
    str | None,
    typer.Option(
        metavar="URL",
        help="Serve the LiDAR of a vehicle that is elsewhere and reports its pose here instead: udpin://127.0.0.1:14551, "
        "udpout://, tcp:// or serial://DEVICE:BAUD.",
    ),
]
_Origin = Annotated[
    str | None, typer.Option(metavar="X,Y,Z", help="With --follow: its local origin in the corridor, m; default: start.")
]
_PoseTimeout = Annotated[
    float, typer.Option(min=0.01, max=10.0, help="With --follow: a pose older than this, s, stops the scans.")
]
_PoseLatency = Annotated[
    float, typer.Option(min=-1.0, max=1.0, help="With --follow: s by which a pose is older than its stamp tells.")
]
_Speed = Annotated[
    float, typer.Option(min=0.0, max=100.0, help="Vehicle seconds per second; 0, with --px4: as fast as PX4 answers.")
]


@app.command(epilog=_EPILOG)
def serve(
    world: Annotated[Path, typer.Option(help="World file (YAML), see configs/worlds/.")],
    seed: Annotated[int | None, typer.Option(min=0, help="Replaces the world's seed; also seeds noise and gusts.")] = None,
    start: Annotated[str | None, typer.Option(metavar="X,Y", help="Replaces the world's start, m.")] = None,
    goal: Annotated[str | None, typer.Option(metavar="X,Y,Z", help="Replaces the world's goal, m (only reported).")] = None,
    dynamics: Annotated[Dynamics, typer.Option(help="What moves the vehicle; jsbsim is an extra.")] = Dynamics.internal,
    vehicle: Annotated[Vehicle, typer.Option(help="Which vehicle: Iris class, or PX4's SIH quad X.")] = Vehicle.iris,
    vehicles: Annotated[
        int, typer.Option(min=1, max=_MOST_VEHICLES, help="How many, side by side; each has the next system id and ports.")
    ] = 1,
    estimate: Annotated[Estimate, typer.Option(help="Errors of the vehicle's own state estimate.")] = Estimate.nominal,
    wind: Annotated[str, typer.Option(metavar="X,Y,Z", help="Steady wind in the corridor frame, m/s.")] = "0,0,0",
    heading: Annotated[float, typer.Option(help="Compass heading of the corridor's x axis, degrees.")] = 0.0,
    onboard_port: Annotated[int, typer.Option(min=1, max=_HIGHEST_PORT, help="UDP port of the onboard client.")] = 14540,
    gcs_port: Annotated[int, typer.Option(min=0, max=_HIGHEST_PORT, help="UDP port of the ground station; 0: none.")] = 14550,
    lidar_port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port of the LiDAR; 0: any free one.")] = 10940,
    link: _Links = None,
    serial_lidar: Annotated[SerialKind | None, typer.Option(help="Also a spinning LiDAR on a pseudo-terminal.")] = None,
    serial_link: Annotated[Path | None, typer.Option(help="Symbolic link to that pseudo-terminal.")] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND@START+DURATION", help="A fault, such as lidar_freeze@12+3; repeatable. See docs/gateway.md."),
    ] = None,
    faults: Annotated[Path | None, typer.Option(help="Scenario file (YAML) of faults.")] = None,
    report: Annotated[Path | None, typer.Option(help="Write the true path, contacts and events here (JSON).")] = None,
    px4: _Px4 = None,
    no_gps: _NoGps = False,
    follow: _Follow = None,
    origin: _Origin = None,
    pose_timeout: _PoseTimeout = 0.3,
    pose_latency: _PoseLatency = 0.0,
    speed: _Speed = 1.0,
    max_time: Annotated[float, typer.Option(min=0.0, help="Stop after this many vehicle seconds; 0: never.")] = 0.0,
    quit_with_parent: Annotated[
        bool, typer.Option("--quit-with-parent", help="Stop when stdin closes or the parent dies.")
    ] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Log more, to stderr.")] = False,
) -> None:
    """Stand in for PX4-SITL: a simulated vehicle with LiDAR in a world, on MAVLink and SCIP ports of this machine.

    Prints one JSON line to stdout when ready. Ctrl-C or SIGTERM stops it and writes the report.
    """
    _log_to_stderr(verbose)
    scene = _load(world, seed, start, goal)
    common: dict[str, Any] = {
        "seed": scene.seed,
        "lidar_port": lidar_port,
        "heading_rad": math.radians(_finite("--heading", heading)),
        "max_time_s": max_time or math.inf,
        "report": report,
        "serial_lidar": serial_lidar.value if serial_lidar is not None else None,
        "serial_link": serial_link,
        "faults": _faults(fault or [], faults),
    }
    _check_report(report)
    moving: dict[str, Any] = {"speed": speed, "wind_m_s": _triple("--wind", wind)}
    simulator, follower = px4 is not None, follow is not None
    _refuse("goes only with --px4", {"--no-gps": no_gps and not simulator, "--speed 0": speed == 0.0 and not simulator})
    _refuse("goes only with --follow", {"--origin": origin is not None and not follower})
    _refuse("goes only with --serial-lidar", {"--serial-link": serial_link is not None and serial_lidar is None})
    _refuse("is the onboard client's port: give another, or 0 for none", {"--gcs-port": gcs_port == onboard_port})
    _refuse("is another role than --follow: choose one", {"--px4": simulator and follower})
    if simulator or follower:
        _refuse("goes with neither --px4 nor --follow", {"--vehicles": vehicles > 1, "--link": bool(link)})
    if px4 is not None:
        _be_simulator(scene, quit_with_parent, address=px4, gps=not no_gps, **common, **moving)
    elif follow is not None:
        if speed != 1.0:
            raise UsageError("--speed: a vehicle that is elsewhere has its own time; leave it out")
        place = _triple("--origin", origin) if origin is not None else None
        times = {"timeout_s": pose_timeout, "latency_s": pose_latency}
        _follow_vehicle(scene, quit_with_parent, url=follow, origin_m=place, **times, **common)
    else:
        ports = {"onboard_port": onboard_port, "gcs_port": gcs_port, "links": _links(link or [])}
        kinds = {"dynamics": dynamics.value, "vehicle": vehicle.value, "estimate": estimate.value}
        _stand_in(scene, vehicles, quit_with_parent, **ports, **kinds, **common, **moving)


def _refuse(why: str, options: dict[str, bool]) -> None:
    """Refuse the first option that was given although it means nothing here."""
    for option, given in options.items():
        if given:
            raise UsageError(f"{option} {why}")


def _stand_in(world: World, vehicles: int, quit_with_parent: bool, **settings: Any) -> None:
    from sim_gateway.gateway import GatewayConfig
    from sim_gateway.serve import serve_fleet

    serve_fleet(world, GatewayConfig(**settings), vehicles, quit_with_parent)


def _be_simulator(world: World, quit_with_parent: bool, **settings: Any) -> None:
    from sim_gateway.px4_gateway import Px4Config
    from sim_gateway.serve import serve_px4

    serve_px4(world, Px4Config(**settings), quit_with_parent)


def _follow_vehicle(world: World, quit_with_parent: bool, **settings: Any) -> None:
    from sim_gateway.follow_gateway import FollowConfig
    from sim_gateway.serve import serve_follow

    serve_follow(world, FollowConfig(**settings), quit_with_parent)


def _load(path: Path, seed: int | None, start: str | None, goal: str | None) -> World:
    """The world with start and goal replaced, if asked; refuses places inside boxes."""
    from dataclasses import replace

    import numpy as np

    from sim_gateway.collision import clearance_m
    from sim_gateway.world import load_world

    world = load_world(path, seed)
    if start is not None:
        x, y = _numbers("--start", start, 2)
        world = replace(world, start=(x, y, 0.0))
    if goal is not None:
        world = replace(world, goal=_triple("--goal", goal))
    for name, point in (("start", world.start), ("goal", world.goal)):
        if clearance_m(world.boxes_at(0.0), np.array(point), 0.0) <= 0.0:
            raise UsageError(f"--{name} {point} lies inside an obstacle: choose another place")
    return world


def _faults(texts: list[str], file: Path | None) -> tuple[Fault, ...]:
    from sim_gateway.faults import Fault, FaultError, load_faults

    try:
        return (*(load_faults(file) if file is not None else ()), *(Fault.parse(text) for text in texts))
    except FaultError as error:
        raise UsageError(str(error)) from None


def _links(texts: list[str]) -> tuple[LinkSpec, ...]:
    from sim_gateway.link_spec import LinkSpec, LinkSpecError

    try:
        return tuple(LinkSpec.parse(text) for text in texts)
    except LinkSpecError as error:
        raise UsageError(str(error)) from None


def _check_report(path: Path | None) -> None:
    """The report is written when the run ends: that it cannot be must be told before."""
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--report {path}: {path.parent}: {error.strerror}") from None
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise UsageError(f"--report {path}: {'is a folder' if path.is_dir() else 'cannot be written'}: name another file")


def _numbers(option: str, text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise UsageError(f"{option} {text!r}: give {count} finite numbers separated by commas, without spaces")
    return values


def _triple(option: str, text: str) -> tuple[float, float, float]:
    x, y, z = _numbers(option, text, 3)
    return (x, y, z)


def _finite(option: str, value: float) -> float:
    if not math.isfinite(value):
        raise UsageError(f"{option} {value}: give a finite number")
    return value


def _log_to_stderr(verbose: bool) -> None:
    from rich.console import Console
    from rich.logging import RichHandler

    handler = RichHandler(console=Console(stderr=True), show_path=False)
    logging.basicConfig(level=logging.DEBUG if verbose else logging.INFO, format="%(message)s", handlers=[handler])
    for noisy in ("numba", "asyncio"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


def completed(arguments: list[str]) -> list[str]:
    """The arguments with the value that `--px4` alone stands for."""
    given: list[str] = []
    for argument, after in pairwise([*arguments, "--"]):
        given += [argument, _PX4_DEFAULT] if argument == "--px4" and after.startswith("-") else [argument]
    return given


def main() -> None:
    """Entry point: a user's mistake is one line on stderr and exit code 2; a vehicle that diverged, exit code 1."""
    from sim_gateway.errors import DivergedError
    from strict_yaml import ConfigError

    try:
        code = app(completed(sys.argv[1:]), standalone_mode=False)
    except DivergedError as error:
        print(f"sim-gateway: {error}", file=sys.stderr)
        code = 1
    except (UsageError, ConfigError) as error:
        print(f"sim-gateway: {error}", file=sys.stderr)
        code = 2
    except Exception as error:
        if not hasattr(error, "format_message"):  # typer's usage errors have no public base class
            raise
        print(f"sim-gateway: {error.format_message().rstrip('.')}; see sim-gateway --help", file=sys.stderr)
        code = 2
    sys.exit(int(code or 0))
