"""RPLIDAR decoders: published vectors, round trips through independent encoders, damage, a million mutated bytes each."""

from __future__ import annotations

import random
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from spinning_peers import dense_capsule, express_capsule, node

from flight.lidar import rplidar
from flight.lidar.points import PointDecoder, Points, join_points
from flight.lidar.rplidar import AnswerReader, RplidarError
from flight.lidar.rplidar_decoders import CapsuleDecoder, StandardDecoder

MUTATED_BYTES = 1_000_000
SAMPLE_S = 1.0 / 8000.0


def fed(one: PointDecoder, data: bytes, size: int = 61) -> Points:
    return join_points([one.feed(data[i : i + size]) for i in range(0, len(data), size)])


def bearings_deg(points: Points) -> np.ndarray:
    return np.degrees(points.bearing_rad)


# -- requests and answers -------------------------------------------------------------------------------------------


def test_requests_on_the_wire() -> None:
    assert rplidar.request(rplidar.STOP) == b"\xa5\x25"
    assert rplidar.express_request(0) == bytes.fromhex("A582050000000000" + "22"), "the SDK's express request"
    pwm = rplidar.request(rplidar.SET_MOTOR_PWM, (660).to_bytes(2, "little"))
    assert pwm == bytes.fromhex("A5F002940200")[:5] + bytes([0xA5 ^ 0xF0 ^ 0x02 ^ 0x94 ^ 0x02])
    assert len(rplidar.conf_request(0x75, 2)) == 3 + 36 + 1
    with pytest.raises(RplidarError):
        rplidar.request(rplidar.STOP, b"x")


@pytest.mark.parametrize(
    ("descriptor", "kind"),
    [
        ("A55A0500004081", 0x81),
        ("A55A5400004082", 0x82),
        ("A55A5400004085", 0x85),
        ("A55A0D03004083", 0x83),
        ("A55A8400004084", 0x84),
        ("A55AAA00004086", 0x86),
    ],
)
def test_descriptors_of_streams(descriptor: str, kind: int) -> None:
    reader = AnswerReader()
    answers = reader.feed(b"\x00RP LIDAR\xa5" + bytes.fromhex(descriptor) + b"\x01\x02")
    assert [(a.kind, a.streams) for a in answers] == [(kind, True)]
    assert reader.rest == b"\x01\x02"


def test_answers_in_any_chunks_and_with_rubbish_between() -> None:
    health = bytes.fromhex("A55A0300000006") + b"\x02\x34\x12"
    info = bytes.fromhex("A55A1400000004") + bytes([0x18, 29, 1, 7]) + bytes(range(16))
    rate = bytes.fromhex("A55A0400000015") + b"\xf4\x01\x7d\x00"
    reader, found = AnswerReader(), []
    for byte in b"\xa5\xa5\x5a\x00" + health + b"banner\r\n" + info + rate:
        found += reader.feed(bytes([byte]))
    assert rplidar.decode_health(found[0]) == (2, 0x1234)
    assert rplidar.decode_info(found[1]) == rplidar.DeviceInfo(0x18, (1, 29), 7, bytes(range(16)).hex().upper())
    assert rplidar.decode_sample_rate(found[2]) == (500, 125)
    with pytest.raises(RplidarError):
        rplidar.decode_info(found[0])


def test_an_answer_to_another_question_is_refused() -> None:
    reader = AnswerReader()
    (answer,) = reader.feed(bytes.fromhex("A55A0600000020") + b"\x70\x00\x00\x00\x03\x00")
    assert rplidar.decode_conf(answer, 0x70) == b"\x03\x00"
    with pytest.raises(RplidarError, match="70"):
        rplidar.decode_conf(answer, 0x75)


def test_answers_from_noise_never_raise_and_never_grow() -> None:
    rng = random.Random(2)
    reader = AnswerReader()
    for _ in range(2000):
        piece = rng.randbytes(200) + rng.choice(
            (b"", b"\xa5\x5a", b"\xa5\x5a\x14\x00\x00\x00\x04", b"\xa5\x5a\xff\xff\xff\x3f\x04")
        )
        for answer in reader.feed(piece):
            assert answer.kind in (0x04, 0x06, 0x15, 0x20, 0x81, 0x82, 0x85)
        assert reader.buffered_bytes < 200


# -- standard nodes -------------------------------------------------------------------------------------------------


def turn_of_nodes(distance_mm: Callable[[float], float], turns: int = 1, step_deg: float = 0.5) -> bytes:
    angles = [k * step_deg for k in range(round(360 / step_deg))] * turns
    return b"".join(node(angle, distance_mm(angle), start=angle == 0.0) for angle in angles)


def test_nodes_come_back_clockwise_with_unknown_where_nothing_returned() -> None:
    points = fed(StandardDecoder(SAMPLE_S), turn_of_nodes(lambda angle: 0 if angle < 90 else 1000.25 + angle))
    assert len(points) == 720
    np.testing.assert_allclose(np.remainder(-bearings_deg(points), 360.0), np.arange(720) * 0.5, atol=1e-6)
    assert np.isnan(points.range_m[:180]).all()
    np.testing.assert_allclose(points.range_m[180:], [(1000.25 + 0.5 * k) / 1000.0 for k in range(180, 720)], rtol=1e-5)
    assert points.intensity[200] == 15 * 4


def test_nodes_are_found_from_any_byte_on() -> None:
    data = turn_of_nodes(lambda angle: 1000 + 7 * angle)
    for skip in range(1, 6):
        points = fed(StandardDecoder(SAMPLE_S), data[skip:])
        assert len(points) == 719 - (skip - 1) // 5
        assert points.range_m[-1] == pytest.approx((1000 + 7 * 359.5) / 1000, abs=3e-4)


def test_a_lost_byte_costs_few_nodes_and_no_wrong_one() -> None:
    data = bytearray(turn_of_nodes(lambda angle: 1000 + 7 * angle))
    del data[1002]
    one = StandardDecoder(SAMPLE_S)
    points = fed(one, bytes(data))
    assert 710 <= len(points) < 720
    assert one.bad_frames >= 1
    expected = 1.0 + 7e-3 * np.remainder(-bearings_deg(points), 360.0)
    np.testing.assert_allclose(points.range_m, expected, atol=1e-3)


def test_fewer_nodes_than_prove_a_position_are_held_back() -> None:
    one = StandardDecoder(SAMPLE_S)
    data = turn_of_nodes(lambda angle: 1000)
    assert len(one.feed(data[:39])) == 0
    assert len(one.feed(data[39:40])) == 8
    assert one.buffered_bytes == 0


# -- capsules -------------------------------------------------------------------------------------------------------


def express_turn(distance_mm: Callable[[float], int], turns: int = 1, capsule_deg: float = 12.0) -> list[bytes]:
    capsules = []
    for k in range(round(360 / capsule_deg) * turns):
        start = capsule_deg * k % 360.0
        angles = [(start + capsule_deg / 32 * i) % 360.0 for i in range(32)]
        capsules.append(express_capsule(start, [(distance_mm(angle), 0) for angle in angles], first=k == 0))
    return capsules


def dense_turn(distance_mm: Callable[[float], int], turns: int = 1, capsule_deg: float = 12.0) -> list[bytes]:
    capsules = []
    for k in range(round(360 / capsule_deg) * turns):
        start = capsule_deg * k % 360.0
        angles = [(start + capsule_deg / 40 * i) % 360.0 for i in range(40)]
        capsules.append(dense_capsule(start, [distance_mm(angle) for angle in angles], first=k == 0))
    return capsules


CAPSULES = pytest.mark.parametrize(("dense", "turn", "count"), [(False, express_turn, 32), (True, dense_turn, 40)])


@CAPSULES
def test_capsules_come_back_one_late(dense: bool, turn: Callable[..., list[bytes]], count: int) -> None:
    capsules = turn(lambda angle: 500 + round(10 * angle))
    one = CapsuleDecoder(SAMPLE_S, dense=dense)
    assert len(one.feed(capsules[0])) == 0
    points = fed(one, b"".join(capsules[1:]))
    assert len(points) == count * (len(capsules) - 1)
    clockwise = np.remainder(-bearings_deg(points) + 1e-9, 360.0)
    np.testing.assert_allclose(clockwise, np.arange(len(points)) * 12.0 / count, atol=1e-6)
    np.testing.assert_allclose(points.range_m, [(500 + round(10 * a)) / 1000 for a in clockwise], atol=1.1e-3)
    assert points.before_end_s[0] == pytest.approx((2 * count - 1) * SAMPLE_S)
    assert points.before_end_s[count - 1] == pytest.approx(count * SAMPLE_S)
    assert (one.bad_checksums, one.bad_frames) == (0, 0)


def test_angle_offsets_of_the_express_format_are_subtracted() -> None:
    points_in = [(1000, k % 64) for k in range(32)]
    one = CapsuleDecoder(SAMPLE_S, dense=False)
    one.feed(express_capsule(90.0, points_in, first=True))
    points = one.feed(express_capsule(102.0, points_in))
    expected = [-(90.0 + 12.0 / 32 * k - (k % 64) / 8.0) for k in range(32)]
    np.testing.assert_allclose(bearings_deg(points), expected, atol=1e-9)


@CAPSULES
def test_a_broken_capsule_takes_its_neighbours_points_along_but_bends_none(
    dense: bool, turn: Callable[..., list[bytes]], count: int
) -> None:
    capsules = turn(lambda angle: 500 + round(10 * angle))
    broken = bytearray(capsules[10])
    broken[40] ^= 0x10
    capsules[10] = bytes(broken)
    del capsules[20]
    one = CapsuleDecoder(SAMPLE_S, dense=dense)
    points = fed(one, b"".join(capsules))
    clockwise = np.remainder(-bearings_deg(points) + 1e-9, 360.0)
    np.testing.assert_allclose(points.range_m, [(500 + round(10 * a)) / 1000 for a in clockwise], atol=1.1e-3)
    assert one.bad_checksums == 1
    assert len(points) >= count * (len(capsules) - 6)


@CAPSULES
def test_no_single_flipped_bit_gives_a_point_of_that_capsule(dense: bool, turn: Callable[..., list[bytes]], count: int) -> None:
    capsules = turn(lambda angle: 700)
    for bit in range(8 * rplidar.CAPSULE_BYTES):
        broken = bytearray(capsules[1])
        broken[bit // 8] ^= 1 << bit % 8
        one = CapsuleDecoder(SAMPLE_S, dense=dense)
        assert len(fed(one, capsules[0] + bytes(broken) + capsules[2])) == 0


@given(st.lists(st.integers(1, 300), min_size=1, max_size=20), st.integers(0, 3))
@settings(max_examples=40, deadline=None)
def test_any_chunks_give_the_same_points(cuts: list[int], which: int) -> None:
    rng = random.Random(9)
    data = [
        turn_of_nodes(lambda angle: rng.randrange(4000)),
        b"".join(express_turn(lambda angle: rng.randrange(4000))),
        b"".join(dense_turn(lambda angle: rng.randrange(4000))),
        b"\x00" * 5 + b"".join(dense_turn(lambda angle: rng.randrange(4000))),
    ][which]
    whole, parts = fed(a_decoder(which), data, len(data)), []
    one, place, turn = a_decoder(which), 0, 0
    while place < len(data):
        step = cuts[turn % len(cuts)]
        parts.append(one.feed(data[place : place + step]))
        place, turn = place + step, turn + 1
    cut = join_points(parts)
    np.testing.assert_array_equal(cut.range_m, whole.range_m)
    np.testing.assert_array_equal(cut.bearing_rad, whole.bearing_rad)


def a_decoder(which: int) -> PointDecoder:
    return StandardDecoder(SAMPLE_S) if which == 0 else CapsuleDecoder(SAMPLE_S, dense=which >= 2)


# -- a million mutated bytes ----------------------------------------------------------------------------------------


def mutated(rng: random.Random, clean: bytes) -> bytes:
    data = bytearray(clean)
    for _ in range(max(1, len(data) // 400)):
        place, kind = rng.randrange(len(data)), rng.randrange(4)
        if kind == 0:
            data[place] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[place : place + rng.randrange(1, 100)]
        elif kind == 2:
            data[place:place] = rng.randbytes(rng.randrange(1, 100))
        else:
            data[place:place] = data[place : place + rng.randrange(1, 100)]
    return bytes(data)


def good_capsules(data: bytes) -> list[bytes]:
    """Every place where a capsule with a right checksum stands, found without the decoder."""
    found = []
    for i in range(len(data) - 83):
        if data[i] // 16 == 0xA and data[i + 1] // 16 == 0x5:
            total = 0
            for byte in data[i + 2 : i + 84]:
                total ^= byte
            if (data[i] % 16) + 16 * (data[i + 1] % 16) == total:
                found.append(data[i : i + 84])
    return found


def distances_of(capsule: bytes, dense: bool) -> set[int]:
    if dense:
        return {int.from_bytes(capsule[k : k + 2], "little") for k in range(4, 84, 2)}
    places = [k for cabin in range(16) for k in (4 + 5 * cabin, 6 + 5 * cabin)]
    return {int.from_bytes(capsule[k : k + 2], "little") // 4 for k in places}


@CAPSULES
def test_a_million_mutated_capsule_bytes(dense: bool, turn: Callable[..., list[bytes]], count: int) -> None:
    rng = random.Random(11)
    one = CapsuleDecoder(SAMPLE_S, dense=dense)
    seen = points_seen = 0
    before = b""
    while seen < MUTATED_BYTES:
        data = mutated(rng, b"".join(turn(lambda angle: rng.randrange(1, 12000), turns=4)))
        allowed = set().union(*(distances_of(capsule, dense) for capsule in good_capsules(before + data)))
        place = 0
        while place < len(data):
            size = rng.choice((1, 83, 84, 85, 700, 4000))
            points = one.feed(data[place : place + size])
            place += size
            assert one.buffered_bytes <= 2 * rplidar.CAPSULE_BYTES
            assert np.isfinite(points.bearing_rad).all()
            assert {round(float(v) * 1000) for v in points.range_m[~np.isnan(points.range_m)]} <= allowed
            points_seen += len(points)
        before = data[-200:]
        seen += len(data)
    assert points_seen > 0.2 * count * MUTATED_BYTES / rplidar.CAPSULE_BYTES
    assert one.bad_checksums > 100


def test_a_million_mutated_node_bytes() -> None:
    """Nodes have no checksum: none may raise, memory stays, and at most few wrong points slip through."""
    rng = random.Random(12)
    one = StandardDecoder(SAMPLE_S)
    seen = points_seen = wrong = 0
    while seen < MUTATED_BYTES:
        data, place = mutated(rng, turn_of_nodes(lambda angle: 1000 + 7 * angle, turns=4)), 0
        while place < len(data):
            size = rng.choice((1, 4, 5, 39, 700, 4000))
            points = one.feed(data[place : place + size])
            place += size
            assert one.buffered_bytes < 60
            expected = 1.0 + 7e-3 * np.remainder(-bearings_deg(points), 360.0)
            wrong += int(np.count_nonzero(np.isnan(points.range_m) | (np.abs(points.range_m - expected) > 0.02)))
            points_seen += len(points)
        seen += len(data)
    assert points_seen > 0.5 * MUTATED_BYTES / 5
    assert wrong < 0.005 * points_seen, f"{wrong} of {points_seen}"


@pytest.mark.parametrize("which", [0, 1, 2])
def test_pure_noise_and_floods(which: int) -> None:
    rng = random.Random(5)
    one = a_decoder(which)
    points = sum(len(one.feed(rng.randbytes(4096))) for _ in range(64))
    assert points < 64 * 4096 / 84 / 20
    one.feed(b"\xa5" * 5_000_000)
    assert one.buffered_bytes < 200
