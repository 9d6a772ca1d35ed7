"""Waiting for what a LiDAR driver's thread does."""

from __future__ import annotations

import time
from collections.abc import Callable

from flight.lidar import LidarDriver
from safety.messages import LidarScan


def until(condition: Callable[[], bool], timeout_s: float = 5.0) -> bool:
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        if condition():
            return True
        time.sleep(0.005)
    return condition()


def next_scan(driver: LidarDriver, timeout_s: float = 5.0) -> LidarScan:
    scan = driver.wait_for_scan(timeout_s)
    assert scan is not None, driver.health()
    return scan
