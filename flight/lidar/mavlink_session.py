"""OBSTACLE_DISTANCE messages, put into the driver's inbox by the vehicle link, as a source of scans."""

from __future__ import annotations

import math
from collections.abc import Iterator

from flight.lidar.clock import OneWayClock
from flight.lidar.inbox import Letter
from flight.lidar.obstacle_distance import NAME, ObstacleDistanceError, decode_obstacle_distance
from flight.lidar.reduce import Mounting
from flight.lidar.session import POLL_S, Host
from flight.lidar.transport import TransportError
from safety.messages import LidarScan


class MavlinkSession:
    """See `session.Session`. Nothing is opened: who has the MAVLink link feeds the inbox."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._clock = OneWayClock()
        self._refused = host.inbox.refused
        self._why = ""

    @property
    def clock_uncertainty_s(self) -> float:
        """Infinite: the sender's clock cannot be asked."""
        return math.inf

    @property
    def clock_drift_s(self) -> float:
        """Of the sender's clock."""
        return self._clock.drift_s

    def open(self) -> str:
        """Wait for the first message."""
        deadline_s = self._host.now() + self._host.config.reply_timeout_s
        while self._host.now() < deadline_s and not self._host.stop.is_set():
            if self._host.inbox.wait(POLL_S):
                return f"MAVLink {NAME}"
        raise TransportError(f"no {NAME} from the vehicle: is a sensor connected to it, and the message streamed?")

    def quit(self) -> None:
        """Nothing to stop."""

    def close(self) -> None:
        """Nothing to close."""

    def scans(self) -> Iterator[LidarScan]:
        """Scans as they are put in. Raises when none comes for a while."""
        host = self._host
        newest_s = -math.inf
        deadline_s = host.now() + host.config.stall_timeout_s
        while not host.stop.is_set():
            letter = host.inbox.take(min(POLL_S, host.config.stall_timeout_s))
            scan = self._scan(letter) if letter is not None else None
            if scan is not None and scan.time_s > newest_s:
                newest_s = scan.time_s
                deadline_s = host.now() + host.config.stall_timeout_s
                yield scan
            elif letter is not None:
                host.count_bad(0, 1)
            self._count_refused()
            if host.now() > deadline_s:
                raise TransportError(f"no good {NAME} for {host.config.stall_timeout_s:g} s{self._why}")

    def _count_refused(self) -> None:
        refused = self._host.inbox.refused
        if refused != self._refused:
            self._host.count_bad(0, refused - self._refused)
            self._refused = refused
            self._why = f"; a second sender of {NAME} is ignored: switch one of them off"

    def _scan(self, letter: Letter) -> LidarScan | None:
        config = self._host.config
        try:
            seen = decode_obstacle_distance(letter.text)
        except ObstacleDistanceError as error:
            self._why = f": {error}"
            return None
        measured_s = letter.arrived_s
        if seen.stamp_s > 0.0:
            measured_s = self._clock.measured_at(seen.stamp_s, letter.arrived_s)
        range_max_m = min(seen.range_max_m, config.range_max_m or math.inf)
        ranges = seen.ranges_m
        ranges[ranges > range_max_m] = math.inf
        mounting = Mounting(config, seen.angle_min_rad, seen.angle_increment_rad, ranges.size)
        return LidarScan(
            time_s=measured_s - config.extra_age_s,
            ranges_m=mounting.apply(ranges),
            angle_min_rad=mounting.angle_min_rad,
            angle_increment_rad=mounting.angle_increment_rad,
            range_min_m=seen.range_min_m,
            range_max_m=range_max_m,
        )
