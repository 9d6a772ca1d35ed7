"""The ``sim-gateway`` command."""

from __future__ import annotations

import json
import logging
import math
import os
import signal
import stat
import sys
import threading
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from sim_gateway.faults import Fault
    from sim_gateway.gateway import GatewayConfig
    from sim_gateway.px4_gateway import Px4Config
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

sim-gateway --world configs/worlds/corridor.yaml --px4

sim-gateway --world configs/worlds/corridor.yaml --px4 serial:/dev/ttyACM0,921600

Then connect a MAVSDK client to udpin://127.0.0.1:14540 and a Hokuyo SCIP driver to 127.0.0.1:10940.
"""
_MOST_VEHICLES = 40  # then the onboard ports would meet the gateway's own
_PX4_DEFAULT = "tcp:4560"
_HIGHEST_PORT = 65535 - 4020 - _MOST_VEHICLES  # the gateway's own ports lie up to this far above the client's

app = typer.Typer(add_completion=False, rich_markup_mode="rich")


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


class _UsageError(Exception):
    """A mistake of the user's; one line that says what to change."""


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
    serial_lidar: Annotated[SerialKind | None, typer.Option(help="Also a spinning LiDAR on a pseudo-terminal.")] = None,
    serial_link: Annotated[Path | None, typer.Option(help="Symbolic link to that pseudo-terminal.")] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND@START+DURATION", help="A fault, such as lidar_freeze@12+3; repeatable. See docs/gateway.md."),
    ] = None,
    faults: Annotated[Path | None, typer.Option(help="Scenario file (YAML) of faults.")] = None,
    report: Annotated[Path | None, typer.Option(help="Write the true path, contacts and events here (JSON).")] = None,
    px4: Annotated[
        str | None,
        typer.Option(
            metavar="[tcp:PORT|serial:DEVICE,BAUD]",
            help="Be the simulator of a real PX4 (SITL: airframe 10016 none_iris; serial: HITL) instead. Alone: tcp:4560.",
        ),
    ] = None,
    no_gps: Annotated[bool, typer.Option("--no-gps", help="With --px4: vision odometry instead of GPS.")] = False,
    speed: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Vehicle seconds per second; 0, with --px4: as fast as PX4 answers.")
    ] = 1.0,
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
        "wind_m_s": _triple("--wind", wind),
        "heading_rad": math.radians(_finite("--heading", heading)),
        "speed": speed,
        "max_time_s": max_time or math.inf,
        "report": report,
        "serial_lidar": serial_lidar.value if serial_lidar is not None else None,
        "serial_link": serial_link,
        "faults": _faults(fault or [], faults),
    }
    if px4 is not None:
        from sim_gateway.px4_gateway import Px4Config

        _serve_px4(scene, Px4Config(address=px4, gps=not no_gps, **common), quit_with_parent)
        return
    if speed == 0.0 or no_gps:
        raise _UsageError(f"{'--no-gps' if no_gps else '--speed 0'} goes only with --px4")
    from sim_gateway.gateway import GatewayConfig

    vehicle_facts = {"dynamics": dynamics.value, "vehicle": vehicle.value, "estimate": estimate.value}
    config = GatewayConfig(onboard_port=onboard_port, gcs_port=gcs_port, **vehicle_facts, **common)
    _serve(scene, config, vehicles, quit_with_parent)


def _stop_event(quit_with_parent: bool) -> threading.Event:
    """What is set when somebody wants this program to end."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if quit_with_parent:
        _follow_parent(stop)
    return stop


def _serve_px4(world: World, config: Px4Config, quit_with_parent: bool) -> None:
    from sim_gateway.px4_gateway import Px4Gateway, warm_up
    from sim_gateway.px4_wire import Px4LineError
    from sim_gateway.scip import ScipServerError

    stop = _stop_event(quit_with_parent)
    try:
        warm_up(world)
        gateway = Px4Gateway(world, config)
    except Px4LineError as error:
        raise _UsageError(f"{error}: choose another with --px4") from None
    except ScipServerError as error:
        raise _UsageError(f"{error} with --lidar-port") from None
    except FileExistsError:
        raise _UsageError(f"--serial-link {config.serial_link} exists and is not a link: choose another name") from None
    with gateway:
        ready = gateway.ready_message()
        print(json.dumps(ready), flush=True)
        log = logging.getLogger("sim_gateway")
        log.info("world %s: PX4 on %s, LiDAR on TCP port %d; Ctrl-C stops", world.name, ready["px4"], ready["lidar_port"])
        gateway.run(stop)


def _serve(world: World, config: GatewayConfig, vehicles: int, quit_with_parent: bool) -> None:
    from sim_gateway.errors import DynamicsMissingError
    from sim_gateway.fleet import Fleet, NoRoomError
    from sim_gateway.gateway import warm_up
    from sim_gateway.mavlink_links import PortInUseError
    from sim_gateway.scip import ScipServerError

    stop = _stop_event(quit_with_parent)
    try:
        warm_up(world, config.dynamics)
        fleet = Fleet(world, config, vehicles)
    except DynamicsMissingError as error:
        raise _UsageError(str(error)) from None
    except NoRoomError as error:
        raise _UsageError(f"{error}: fewer --vehicles, or another --start") from None
    except PortInUseError as error:
        raise _UsageError(f"{error}: stop the program there, or choose another with --onboard-port or --gcs-port") from None
    except ScipServerError as error:
        raise _UsageError(f"{error} with --lidar-port") from None
    except FileExistsError:
        raise _UsageError(f"--serial-link {config.serial_link} exists and is not a link: choose another name") from None
    with fleet:
        print(json.dumps(fleet.ready_message()), flush=True)
        for gateway in fleet.gateways:
            logging.getLogger("sim_gateway").info(
                "world %s, vehicle %d: MAVLink to udpin://127.0.0.1:%d, LiDAR on TCP port %d; Ctrl-C stops",
                *(world.name, gateway.config.system_id, gateway.config.onboard_port, gateway.lidar.port),
            )
        fleet.run(stop)


def _follow_parent(stop: threading.Event) -> None:
    """Set `stop` when stdin, if it is a pipe, ends or this process gets another parent.

    Not by Linux's parent-death signal: that one comes already when the thread that started this process ends.
    """
    parent = os.getppid()

    def read_to_end() -> None:
        while os.read(sys.stdin.fileno(), 4096):  # not sys.stdin.buffer: a thread inside its lock aborts the interpreter at exit
            pass
        stop.set()

    def watch_parent() -> None:
        while not stop.wait(0.5):
            if os.getppid() != parent:
                stop.set()

    for watcher in (read_to_end, watch_parent) if _stdin_is_pipe() else (watch_parent,):
        threading.Thread(target=watcher, daemon=True).start()


def _stdin_is_pipe() -> bool:
    try:
        mode = os.fstat(0).st_mode
    except OSError:  # no stdin at all
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)


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
            raise _UsageError(f"--{name} {point} lies inside an obstacle: choose another place")
    return world


def _faults(texts: list[str], file: Path | None) -> tuple[Fault, ...]:
    from sim_gateway.faults import Fault, FaultError, load_faults

    try:
        return (*(load_faults(file) if file is not None else ()), *(Fault.parse(text) for text in texts))
    except FaultError as error:
        raise _UsageError(str(error)) from None


def _numbers(option: str, text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise _UsageError(f"{option} {text!r}: give {count} finite numbers separated by commas, without spaces")
    return values


def _triple(option: str, text: str) -> tuple[float, float, float]:
    x, y, z = _numbers(option, text, 3)
    return (x, y, z)


def _finite(option: str, value: float) -> float:
    if not math.isfinite(value):
        raise _UsageError(f"{option} {value}: give a finite number")
    return value


def _log_to_stderr(verbose: bool) -> None:
    from rich.console import Console
    from rich.logging import RichHandler

    handler = RichHandler(console=Console(stderr=True), show_path=False)
    logging.basicConfig(level=logging.DEBUG if verbose else logging.INFO, format="%(message)s", handlers=[handler])
    for noisy in ("numba", "asyncio"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


def _completed(arguments: list[str]) -> list[str]:
    """The arguments with the value that `--px4` alone stands for."""
    given: list[str] = []
    for argument, after in zip(arguments, [*arguments[1:], "--"], strict=True):
        given += [argument, _PX4_DEFAULT] if argument == "--px4" and after.startswith("-") else [argument]
    return given


def main() -> None:
    """Entry point: a user's mistake is one line on stderr and exit code 2; a vehicle that diverged, exit code 1."""
    from sim_gateway.errors import DivergedError
    from strict_yaml import ConfigError

    try:
        code = app(_completed(sys.argv[1:]), standalone_mode=False)
    except DivergedError as error:
        print(f"sim-gateway: {error}", file=sys.stderr)
        code = 1
    except (_UsageError, ConfigError) as error:
        print(f"sim-gateway: {error}", file=sys.stderr)
        code = 2
    except Exception as error:
        if not hasattr(error, "format_message"):  # typer's usage errors have no public base class
            raise
        print(f"sim-gateway: {error.format_message()} See sim-gateway --help.", file=sys.stderr)
        code = 2
    sys.exit(int(code or 0))
