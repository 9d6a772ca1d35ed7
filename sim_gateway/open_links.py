"""The links of one vehicle: PX4's two UDP links, with the quality asked for, and further ones."""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from sim_gateway.link_conditions import LinkConditions
from sim_gateway.link_spec import LinkSpec
from sim_gateway.mavlink_links import MavlinkLink, PortInUseError, UdpLink
from sim_gateway.pty_port import PtyPort
from sim_gateway.serial_port import SerialPort
from sim_gateway.stream_links import SerialLink, TcpLink
from sim_gateway.stream_rates import GROUND, ONBOARD

# distance from the port a client listens on to the gateway's own port, as in PX4's SITL (14580 - 14540, 18570 - 14550)
ONBOARD_PORT_OFFSET, GROUND_PORT_OFFSET = 40, 4020


class _Vehicle(Protocol):
    @property
    def system_id(self) -> int: ...

    @property
    def seed(self) -> int: ...


def link_plan(onboard_port: int, ground_port: int, asked: Sequence[LinkSpec]) -> list[LinkSpec]:
    """The onboard link first, then the ground station's (port 0: none), then others.

    A UDP link that was asked for on one of their ports on this machine stands in its place.
    """
    usual = [LinkSpec("udp", port=onboard_port)]
    if ground_port:
        usual.append(LinkSpec("udp", port=ground_port, streams="ground"))
    plan = [next((replace(link, streams=plain.streams) for link in asked if _same_place(link, plain)), plain) for plain in usual]
    return plan + [link for link in asked if not any(_same_place(link, plain) for plain in usual)]


def nth_links(links: Sequence[LinkSpec], index: int, ground_port: int) -> tuple[LinkSpec, ...]:
    """The same for a further vehicle, from 0: ports move along, but not the ground station's, which all speak to."""
    ground = LinkSpec("udp", port=ground_port)
    return tuple(link if _same_place(link, ground) else link.nth(index) for link in links)


def _same_place(one: LinkSpec, other: LinkSpec) -> bool:
    return (one.kind, one.host, one.port, one.path) == (other.kind, other.host, other.port, other.path)


def open_links(plan: Sequence[LinkSpec], now_s: Callable[[], float], vehicle: _Vehicle) -> list[MavlinkLink]:
    """All of them, or none. Raises `PortInUseError`, `SerialPortError`, `FileExistsError` for the name of a pseudo-terminal."""
    links: list[MavlinkLink] = []
    try:
        for number, spec in enumerate(plan):
            link = _open(spec, now_s, vehicle.system_id)
            links.append(link)
            if not spec.quality.perfect:
                seed = 1000 * vehicle.seed + number
                link.conditions = LinkConditions(spec.quality, seed, in_order=spec.kind != "udp")
    except Exception:
        for link in links:
            link.close()
        raise
    return links


def _open(spec: LinkSpec, now_s: Callable[[], float], system_id: int) -> MavlinkLink:
    column = GROUND if spec.ground else ONBOARD
    name = "ground station" if spec.ground else "onboard"
    if spec.kind == "udp":
        own = spec.port + (GROUND_PORT_OFFSET + system_id - 1 if spec.ground else ONBOARD_PORT_OFFSET)
        return UdpLink(name, own, spec.port, column, now_s, system_id, _address(spec.host))
    if spec.kind == "tcp":
        return TcpLink(name, (_address(spec.host), spec.port), column, now_s, system_id)
    if spec.kind == "serial":
        return SerialLink(name, SerialPort(spec.path, spec.baud), spec.baud, column, now_s, system_id, early=True)
    return SerialLink(name, PtyPort(Path(spec.path) if spec.path else None), spec.baud, column, now_s, system_id)


def _address(host: str) -> str:
    try:
        return socket.gethostbyname(host)
    except OSError as error:
        raise PortInUseError(f"the host {host} is not known ({error})") from error


def ready_links(links: Sequence[MavlinkLink]) -> list[str]:
    """Where clients of the links beyond the two usual ones find them."""
    found = [f"tcp:{link.port}" for link in links if isinstance(link, TcpLink)]
    return found + [f"serial:{link.port.path}" for link in links if isinstance(link, SerialLink)]
