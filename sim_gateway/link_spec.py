"""Which MAVLink links there are, and how good they are, as told on the command line: ``udp:14540,delay_ms=50,loss=0.02``."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

LOOPBACK = "127.0.0.1"
_ONBOARD, _GROUND = "onboard", "ground"
_LONGEST_DELAY_MS = 10_000.0


class LinkSpecError(ValueError):
    """A link that is not described as it must be; the message shows how."""


@dataclass(frozen=True, slots=True)
class LinkQuality:
    """What a link does to messages, both ways. Each is late by `delay_s`, more or less by up to `jitter_s`."""

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    duplicate: float = 0.0

    @property
    def perfect(self) -> bool:
        """Whether it does nothing to them."""
        return not (self.delay_s or self.jitter_s or self.loss or self.duplicate)


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """One link.

    `kind`: udp (to a client on `host` and `port`), tcp (clients connect to `port` on our address `host`), serial (device `path`)
    or pty (a pseudo-terminal, `path` is a link to it or empty). `baud`: bits per second; 0, not for serial: as fast as it goes.
    `streams`: onboard or ground, whose messages and rates.
    """

    kind: str
    host: str = LOOPBACK
    port: int = 0
    path: str = ""
    baud: int = 0
    streams: str = _ONBOARD
    quality: LinkQuality = field(default_factory=LinkQuality)

    @property
    def ground(self) -> bool:
        """Whether it has the ground station's streams."""
        return self.streams == _GROUND

    @staticmethod
    def parse(text: str) -> LinkSpec:
        """A link from ``KIND:PLACE,name=value,...``. Raises `LinkSpecError`."""
        place, *options = text.split(",")
        kind, _, where = place.partition(":")
        if kind not in _PLACES:
            raise LinkSpecError(f"--link {text!r}: begin with one of {', '.join(_PLACES)} and a colon")
        try:
            spec = _options(_PLACES[kind](where), options)
        except ValueError as error:
            raise LinkSpecError(f"--link {text!r}: {error}") from None
        if kind == "serial" and spec.baud == 0:
            raise LinkSpecError(f"--link {text!r}: add the bit rate, such as baud=57600")
        return spec

    def nth(self, index: int) -> LinkSpec:
        """The same link for a further vehicle, from 0. Raises `LinkSpecError` for a serial device: there is only one."""
        if index == 0:
            return self
        if self.kind == "serial":
            raise LinkSpecError(f"serial:{self.path} can belong to one vehicle only")
        if self.kind == "pty":
            path = Path(self.path)
            return replace(self, path=str(path.with_name(f"{path.stem}-{index + 1}{path.suffix}")) if self.path else "")
        return replace(self, port=self.port + index)


def _network(kind: str, where: str) -> LinkSpec:
    host, _, port = where.rpartition(":")
    if not port.isdigit() or not 1 <= int(port) <= 65_535:
        raise ValueError(f"give a port, such as {kind}:14540, or {kind}:HOST:PORT for a network that is not this machine's own")
    return LinkSpec(kind, host or LOOPBACK, int(port))


def _serial(where: str) -> LinkSpec:
    if not where:
        raise ValueError("name the device, such as serial:/dev/ttyUSB0,baud=57600")
    return LinkSpec("serial", path=where)


_PLACES: dict[str, Callable[[str], LinkSpec]] = {
    "udp": lambda where: _network("udp", where),
    "tcp": lambda where: _network("tcp", where),
    "serial": _serial,
    "pty": lambda where: LinkSpec("pty", path=where),
}


def _options(spec: LinkSpec, options: list[str]) -> LinkSpec:
    for option in options:
        name, equals, value = option.partition("=")
        if name in _QUALITIES and equals:
            field_name, scale, most = _QUALITIES[name]
            spec = replace(spec, quality=replace(spec.quality, **{field_name: scale * _number(name, value, most)}))
        elif name == "baud" and value.isdigit() and 300 <= int(value) <= 10_000_000 and spec.kind in ("serial", "pty"):
            spec = replace(spec, baud=int(value))
        elif name == "streams" and value in (_ONBOARD, _GROUND):
            spec = replace(spec, streams=value)
        else:
            raise ValueError(
                f"{option!r} is not known here; there are delay_ms=, jitter_ms=, loss=, dup=, streams=onboard or ground, and "
                "baud= (300 to 10000000; serial and pty)"
            )
    return spec


_QUALITIES = {
    "delay_ms": ("delay_s", 1e-3, _LONGEST_DELAY_MS),
    "jitter_ms": ("jitter_s", 1e-3, _LONGEST_DELAY_MS),
    "loss": ("loss", 1.0, 1.0),
    "dup": ("duplicate", 1.0, 1.0),
}


def _number(name: str, text: str, most: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= most:
        raise ValueError(f"{name} is {text!r}: give a number from 0 to {most:g}")
    return value
