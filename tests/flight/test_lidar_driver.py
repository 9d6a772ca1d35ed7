"""The SCIP driver against a device over TCP that behaves, and one that does not."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from lidar_waits import next_scan, until
from pydantic import ValidationError
from scip_peer import BEAMS, Device

from flight.lidar import LidarDriver, LidarSource, open_lidar
from flight.lidar.clock import MAX_DRIFT, WRAP_MS, DeviceClock, DeviceClockError

QUICK = {"reply_timeout_s": 0.3, "stall_timeout_s": 0.3, "reconnect_min_s": 0.02, "reconnect_max_s": 0.1}


def source(device: Device, **changes: object) -> LidarSource:
    return LidarSource.model_validate({"port": device.port, **QUICK, **changes})


@pytest.fixture
def device() -> Iterator[Device]:
    with Device() as running:
        yield running


def test_a_scan_arrives_with_its_geometry_and_codes(device: Device) -> None:
    values = [1000 + i for i in range(BEAMS)]
    values[0], values[1], values[2], values[-1] = 1, 2, 3, 4001
    device.values = lambda number: values
    with open_lidar(source(device)) as driver:
        scan = next_scan(driver)
    assert scan.ranges_m.shape == (BEAMS,)
    assert scan.angle_min_rad == pytest.approx(-np.pi / 2)
    assert scan.angle_increment_rad == pytest.approx(np.pi / 360)
    assert (scan.range_min_m, scan.range_max_m) == pytest.approx((0.1, 4.0))
    assert scan.ranges_m[0] == np.inf
    assert scan.ranges_m[1] == 0.0
    assert np.isnan(scan.ranges_m[2])
    assert scan.ranges_m[-1] == np.inf
    np.testing.assert_allclose(scan.ranges_m[3:-1], np.array(values[3:-1]) / 1000.0, rtol=1e-6)


def test_the_handshake_is_that_of_the_protocol_and_close_quits(device: Device) -> None:
    with open_lidar(source(device)) as driver:
        next_scan(driver)
    assert device.requests[:3] == ["QT", "PP", "TM0"]
    assert until(lambda: device.requests[-2:] == ["MD0180054001000", "QT"])
    driver.close()
    assert not driver.health().connected
    assert driver.wait_for_scan(0.01) is None


@pytest.mark.parametrize("offset_s", [0.0, -3.0e5, 8.1e4], ids=["same clock", "behind", "ahead"])
def test_scan_time_is_the_device_time_not_the_arrival(device: Device, offset_s: float) -> None:
    device.clock_offset_s = offset_s
    delay_s = 0.04

    def late(message: bytes) -> bytes:
        time.sleep(delay_s)
        return message

    device.rate_hz = 15.0
    device.garble = late
    with open_lidar(source(device)) as driver:
        errors = [next_scan(driver).time_s - device.measured[device.scans_sent - 1] for _ in range(12)]
    assert np.median(np.abs(errors)) < 0.005, errors


def test_the_wrap_of_the_device_clock_does_not_show(device: Device) -> None:
    device.clock_offset_s = WRAP_MS / 1000.0 - (time.monotonic() % (WRAP_MS / 1000.0)) - 0.3
    with open_lidar(source(device)) as driver:
        times, raw = [], []
        for _ in range(40):
            times.append(next_scan(driver).time_s)
            raw.append(device.clock_ms())
        assert driver.health().reconnects == 0
    assert min(raw) < 2000, "the clock wrapped during the test"
    steps = np.diff(times)
    assert (steps > 0.0).all()
    assert steps.max() < 0.5


def test_messages_cut_anywhere_are_put_together(device: Device) -> None:
    device.chunks = True
    device.rate_hz = 25.0
    with open_lidar(source(device)) as driver:
        for _ in range(10):
            assert next_scan(driver).ranges_m[0] == np.float32(1.0)
        health = driver.health()
    assert (health.bad_checksums, health.bad_frames, health.reconnects) == (0, 0, 0)


def test_health_tells_rate_and_age(device: Device) -> None:
    device.rate_hz = 20.0
    with open_lidar(source(device)) as driver:
        for _ in range(20):
            next_scan(driver)
        health = driver.health()
    assert health.connected
    assert health.model == "TEST-30(peer)"
    assert health.rate_hz == pytest.approx(20.0, rel=0.2)
    assert 0.0 <= health.age_s < 0.1
    assert health.clock_uncertainty_s < 0.02


def test_damaged_scans_are_counted_and_never_shown(device: Device) -> None:
    def damage(message: bytes) -> bytes:
        if device.scans_sent % 2 == 0:
            return message
        broken = bytearray(message)
        broken[200] ^= 0x01
        return bytes(broken)

    device.garble = damage
    with open_lidar(source(device)) as driver:
        expected = np.array([1.0 + i / 1000.0 for i in range(BEAMS)], dtype=np.float32)
        for _ in range(10):
            np.testing.assert_allclose(next_scan(driver).ranges_m, expected, rtol=1e-6)
        health = driver.health()
    assert health.bad_checksums >= 5
    assert health.reconnects == 0


def test_a_damaged_status_line_and_half_a_frame_are_counted(device: Device) -> None:
    def damage(message: bytes) -> bytes:
        turn = device.scans_sent % 4
        if turn == 1:
            return message.replace(b"\n99b\n", b"\n99c\n")
        return message[:500] if turn == 2 else message

    device.garble = damage
    with open_lidar(source(device)) as driver:
        for _ in range(8):
            next_scan(driver)
        health = driver.health()
    assert health.bad_checksums >= 1
    assert health.bad_frames >= 1


def test_unstable_scans_are_skipped_without_alarm(device: Device) -> None:
    device.garble = lambda message: message if device.scans_sent % 2 else b"MD0180054001000\n0M" + b"M\n\n"
    with open_lidar(source(device)) as driver:
        for _ in range(5):
            next_scan(driver)
        health = driver.health()
    assert health.reconnects == 0


def test_a_stall_ends_in_a_new_connection(device: Device) -> None:
    with open_lidar(source(device)) as driver:
        before = next_scan(driver)
        device.stalled = True
        assert until(lambda: device.connections >= 2)
        assert "no good scan" in driver.health().last_error
        assert driver.health().age_s > 0.2
        device.stalled = False
        after = next_scan(driver)
    assert after.time_s > before.time_s
    assert after.sequence > before.sequence
    assert driver.health().reconnects >= 1


def test_a_closed_link_is_opened_again(device: Device) -> None:
    device.close_after = 3
    with open_lidar(source(device)) as driver:
        assert until(lambda: driver.health().reconnects >= 2)
        assert "closed the link" in driver.health().last_error
        next_scan(driver)


def test_a_clock_that_stands_still_is_not_taken_for_new_scans(device: Device) -> None:
    with open_lidar(source(device)) as driver:
        next_scan(driver)
        device.frozen_clock = True
        assert until(lambda: device.connections >= 2)
        assert driver.health().bad_frames > 0


def test_garbage_before_and_between_does_no_harm(device: Device) -> None:
    device.greeting = b"\x00\xffready\n\n" * 20
    device.garble = lambda message: message if device.scans_sent % 2 else b"\n\n" + bytes(range(256)) + b"\n\n" + message
    with open_lidar(source(device)) as driver:
        for _ in range(5):
            next_scan(driver)
        assert driver.health().reconnects == 0


def test_no_device_is_named_and_then_found() -> None:
    with Device() as device:
        port = device.port
    config = LidarSource.model_validate({"port": port, **QUICK})
    with open_lidar(config) as driver:
        assert driver.wait_for_scan(0.2) is None
        assert driver.latest() is None
        assert f"127.0.0.1:{port}" in driver.health().last_error
        assert np.isnan(driver.health().age_s)
        with Device(port=port):
            assert driver.wait_for_scan(5.0) is not None
            assert driver.health().reconnects == 0


@pytest.mark.parametrize("request_line", ["QT", "PP", "TM0", "TM1"])
def test_a_device_that_does_not_answer_is_named(device: Device, request_line: str) -> None:
    device.silent_to = {request_line}
    with open_lidar(source(device)) as driver:
        assert until(lambda: f"did not answer {request_line}" in driver.health().last_error)
        assert driver.latest() is None


def test_a_refused_command_and_impossible_geometry_are_named(device: Device) -> None:
    device.refuse = {"TM0": "01"}
    with open_lidar(source(device)) as driver:
        assert until(lambda: "refused TM0 with status 01" in driver.health().last_error)
        device.refuse = {}
        device.parameters = {"ARES": 10}
        assert until(lambda: "steps a turn" in driver.health().last_error)


def test_time_adjustment_left_on_by_another_client_is_no_obstacle(device: Device) -> None:
    device.refuse = {"TM0": "02", "TM2": "03"}
    with open_lidar(source(device)) as driver:
        next_scan(driver)


def test_close_is_quick_idempotent_and_final(device: Device) -> None:
    device.silent_to = {"PP"}
    driver = open_lidar(source(device, reply_timeout_s=10.0))
    driver.start()
    driver.start()
    assert until(lambda: "PP" in device.requests)
    started_s = time.monotonic()
    driver.close()
    driver.close()
    assert time.monotonic() - started_s < 1.0
    driver.start()
    assert driver.wait_for_scan(0.05) is None
    assert device.connections == 1


def test_a_shorter_trusted_range_makes_the_rest_nothing(device: Device) -> None:
    device.values = lambda number: [1000] * 100 + [3000] * (BEAMS - 100)
    with open_lidar(source(device, range_max_m=2.0)) as driver:
        scan = next_scan(driver)
    assert scan.range_max_m == pytest.approx(2.0)
    assert np.isinf(scan.ranges_m[100:]).all()
    np.testing.assert_allclose(scan.ranges_m[:100], 1.0)


def test_mirror_and_yaw_of_the_mounting(device: Device) -> None:
    device.values = lambda number: [500] + [2000] * (BEAMS - 1)
    with open_lidar(source(device, mirror=True, mount_yaw_deg=30.0)) as driver:
        scan = next_scan(driver)
    assert scan.ranges_m[-1] == np.float32(0.5), "the device's rightmost beam looks left when it hangs upside down"
    last_rad = scan.angle_min_rad + (BEAMS - 1) * scan.angle_increment_rad
    assert last_rad == pytest.approx(np.radians(90.0 + 30.0))


def test_newest_wins(device: Device) -> None:
    device.rate_hz = 100.0
    device.values = lambda number: [1000 + number] * BEAMS
    with open_lidar(source(device)) as driver:
        next_scan(driver)
        time.sleep(0.3)
        scan = driver.latest()
        assert scan is not None
        assert abs(scan.ranges_m[0] * 1000.0 - 1000.0 - device.scans_sent) < 8.0


@pytest.mark.parametrize(
    "section",
    [{"driver": "sick"}, {"port": 0}, {"port": 70000}, {"hots": "x"}, {"mount_yaw_deg": float("nan")}, {"range_max_m": -1},
     {"reconnect_min_s": 2.0}, {"blind_sectors_deg": [[0.0, 400.0]]}],
)  # fmt: skip
def test_a_wrong_section_is_refused(section: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        LidarSource.model_validate(section)


# -- the clock ----------------------------------------------------------------------------------------------------


def synchronised(offset_s: float, now_s: float = 100.0) -> DeviceClock:
    clock = DeviceClock()
    for k, round_trip_s in enumerate((0.02, 0.004, 0.01)):
        sent_s = now_s + 0.05 * k
        clock.synchronise(device_ms(sent_s + 0.5 * round_trip_s, offset_s), sent_s, sent_s + round_trip_s)
    return clock


def device_ms(now_s: float, offset_s: float) -> int:
    return round(1000.0 * (now_s - offset_s)) % WRAP_MS


def replayed(
    clock: DeviceClock, offset_s: Callable[[float], float], latency_s: Callable[[float], float], seconds: float
) -> list[float]:
    """Error of each scan's mapped time, 20 scans a second from t = 101 s."""
    errors = []
    for k in range(int(20 * seconds)):
        now_s = 101.0 + 0.05 * k
        received_s = now_s + latency_s(now_s)
        errors.append(clock.measured_at(device_ms(now_s, offset_s(now_s)), received_s) - now_s)
    return errors


def test_clock_offset_comes_from_the_best_round_trip() -> None:
    clock = synchronised(40.0)
    assert clock.uncertainty_s == pytest.approx(0.003)
    errors = replayed(clock, lambda t: 40.0, lambda t: 0.03, 10.0)
    assert np.abs(errors).max() < 0.002


def test_clock_without_round_trips_uses_the_smallest_delay() -> None:
    errors = replayed(DeviceClock(), lambda t: 40.0, lambda t: 0.005 + 0.02 * (t % 1.0), 5.0)
    assert np.abs(errors[25:]).max() < 0.008


@pytest.mark.parametrize("rate", [5e-5, -5e-5])
def test_crystal_drift_is_followed(rate: float) -> None:
    errors = replayed(synchronised(40.0), lambda t: 40.0 + rate * (t - 101.0), lambda t: 0.01, 600.0)
    assert np.abs(errors).max() < 0.005


def test_a_link_that_becomes_slow_shows_as_age() -> None:
    errors = replayed(synchronised(40.0), lambda t: 40.0, lambda t: 0.01 if t < 110.0 else 0.025, 30.0)
    assert np.abs(errors).max() < 0.002 + MAX_DRIFT * 30.0


def test_a_clock_that_fell_behind_is_measured_again() -> None:
    with pytest.raises(DeviceClockError, match="later"):
        replayed(synchronised(40.0), lambda t: 40.0 if t < 110.0 else 40.2, lambda t: 0.01, 20.0)


def test_a_clock_that_jumps_ahead_never_dates_a_scan_after_its_arrival() -> None:
    clock = synchronised(40.0)
    for k in range(200):
        now_s = 101.0 + 0.05 * k
        assert clock.measured_at(device_ms(now_s, 40.0 if k < 100 else 39.5), now_s + 0.01) <= now_s + 0.01


def test_a_restarted_clock_is_an_error_but_a_scan_under_way_is_not() -> None:
    clock = synchronised(40.0)
    clock.measured_at(device_ms(100.0, 40.0), 101.0)
    with pytest.raises(DeviceClockError, match="ran back"):
        clock.measured_at(device_ms(90.0, 40.0), 102.0)


# -- the gateway's emulator, which is not ours and shares no code with us ------------------------------------------


def gateway_scan(number: int) -> np.ndarray:
    """361 ranges: a slanted wall, nothing, something too near, something the device cannot judge."""
    ranges = np.linspace(0.5, 3.9, BEAMS) + 0.001 * (number % 10)
    ranges[10], ranges[20], ranges[30] = np.inf, 0.0, np.nan
    return ranges


def test_the_gateways_emulator_is_read_to_the_millimetre_and_to_the_clock() -> None:
    server_module = pytest.importorskip("sim_gateway.scip", reason="needs the extra `sim`")
    zero_s = time.monotonic() - 1234.5
    with server_module.ScipServer(lambda: time.monotonic() - zero_s, port=0) as server:
        config = LidarSource.model_validate({"port": server.port, **QUICK})
        with open_lidar(config) as driver:
            assert until(lambda: server.device.state == "multi")
            taken = []
            for number in range(30):
                measured_s = time.monotonic()
                before = driver.latest()
                server.publish(measured_s - zero_s, gateway_scan(number))
                assert until(lambda before=before: driver.latest() is not before)
                taken.append((driver.latest(), measured_s, number))
                time.sleep(0.005)  # the device's clock counts whole milliseconds
            health = driver.health()
    assert (health.bad_checksums, health.bad_frames, health.reconnects) == (0, 0, 0)
    for scan, _, number in taken:
        expected = gateway_scan(number)
        np.testing.assert_allclose(scan.ranges_m, expected, atol=0.00051)
        assert scan.angle_min_rad == pytest.approx(-np.pi / 2)
    assert np.median([abs(scan.time_s - measured_s) for scan, measured_s, _ in taken]) < 0.003


def test_a_restarted_gateway_is_found_again() -> None:
    server_module = pytest.importorskip("sim_gateway.scip", reason="needs the extra `sim`")

    def feed(server: object, zero_s: float, driver: LidarDriver) -> bool:
        server.publish(time.monotonic() - zero_s, gateway_scan(0))  # type: ignore[attr-defined]
        return driver.wait_for_scan(0.03) is not None

    first_s, second_s = time.monotonic() - 5000.0, time.monotonic()
    with server_module.ScipServer(lambda: time.monotonic() - first_s, port=0) as server:
        config = LidarSource.model_validate({"port": server.port, **QUICK})
        driver = open_lidar(config)
        driver.start()
        assert until(lambda: feed(server, first_s, driver))
    with driver, server_module.ScipServer(lambda: time.monotonic() - second_s, port=config.port) as server:
        assert until(lambda: feed(server, second_s, driver))
        scan = driver.latest()
        assert scan is not None
        assert abs(scan.time_s - time.monotonic()) < 0.2, "its clock began again from zero, and was measured again"
        assert driver.health().reconnects >= 1
