"""What the command does once its options are understood: open everything, say that it is ready, run until somebody ends it."""

from __future__ import annotations

import json
import logging
import os
import signal
import stat
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sim_gateway.errors import DynamicsMissingError, UsageError
from sim_gateway.faults import FaultError
from sim_gateway.fleet import Fleet, NoRoomError
from sim_gateway.follow_gateway import FollowConfig, FollowGateway
from sim_gateway.follow_gateway import warm_up as warm_up_follow
from sim_gateway.gateway import GatewayConfig, warm_up
from sim_gateway.link_spec import LinkSpecError
from sim_gateway.mavlink_links import PortInUseError
from sim_gateway.pose_source import FollowUrlError
from sim_gateway.px4_gateway import Px4Config, Px4Gateway
from sim_gateway.px4_gateway import warm_up as warm_up_px4
from sim_gateway.px4_wire import Px4LineError
from sim_gateway.scene import World
from sim_gateway.scip import ScipServerError
from sim_gateway.serial_port import SerialPortError

_log = logging.getLogger("sim_gateway")


@contextmanager
def _usage_errors() -> Iterator[None]:
    """What cannot be opened is told as the option that opens something else."""
    try:
        yield
    except (DynamicsMissingError, FaultError, LinkSpecError, Px4LineError, SerialPortError) as error:
        raise UsageError(str(error)) from None
    except NoRoomError as error:
        raise UsageError(f"{error}: fewer --vehicles, or another --start") from None
    except PortInUseError as error:
        raise UsageError(f"{error}: stop the program there, or choose another: --onboard-port, --gcs-port, --link") from None
    except FollowUrlError as error:
        raise UsageError(f"--follow {error}") from None
    except ScipServerError as error:
        raise UsageError(f"{error} with --lidar-port") from None
    except FileExistsError as error:
        raise UsageError(f"{error.filename2} exists and is not a link: name another (--serial-link, --link pty:)") from None
    except OSError as error:
        if error.filename is None:  # not about a path that somebody named
            raise
        raise UsageError(f"{error.filename2 or error.filename}: {error.strerror}") from None


def serve_fleet(world: World, config: GatewayConfig, vehicles: int, quit_with_parent: bool) -> None:
    """Stand in for PX4."""
    stop = _stop_event(quit_with_parent)
    with _usage_errors():
        warm_up(world, config.dynamics)
        fleet = Fleet(world, config, vehicles)
    with fleet:
        _say_ready(fleet.ready_message())
        for gateway in fleet.gateways:
            _log.info(
                "world %s, vehicle %d: MAVLink to udpin://127.0.0.1:%d, LiDAR on TCP port %d; Ctrl-C stops",
                *(world.name, gateway.config.system_id, gateway.config.onboard_port, gateway.lidar.port),
            )
        fleet.run(stop)


def serve_px4(world: World, config: Px4Config, quit_with_parent: bool) -> None:
    """Simulate for a real PX4."""
    stop = _stop_event(quit_with_parent)
    with _usage_errors():
        warm_up_px4(world)
        gateway = Px4Gateway(world, config)
    with gateway:
        ready = gateway.ready_message()
        _say_ready(ready)
        _log.info("world %s: PX4 on %s, LiDAR on TCP port %d; Ctrl-C stops", world.name, ready["px4"], ready["lidar_port"])
        gateway.run(stop)


def serve_follow(world: World, config: FollowConfig, quit_with_parent: bool) -> None:
    """Serve LiDARs to a vehicle that is elsewhere."""
    stop = _stop_event(quit_with_parent)
    with _usage_errors():
        warm_up_follow(world)
        gateway = FollowGateway(world, config)
    with gateway:
        ready = gateway.ready_message()
        _say_ready(ready)
        _log.info("world %s: following %s, LiDAR on TCP port %d; Ctrl-C stops", world.name, config.url, ready["lidar_port"])
        gateway.run(stop)


def _say_ready(message: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def _stop_event(quit_with_parent: bool) -> threading.Event:
    """What is set when somebody wants this program to end."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if quit_with_parent:
        _follow_parent(stop)
    return stop


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
