"""LD06 decoder: the manual's vectors, round trips through an independent encoder, damage, a million mutated bytes."""

from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from spinning_peers import LD06_EXAMPLE, bitwise_crc, ld06_frame, ld06_turn

from flight.lidar.ld06 import FRAME_BYTES, LD06_POINTS_PER_S, STL27L_POINTS_PER_S, Ld06Decoder, crc8
from flight.lidar.points import Points, join_points

MUTATED_BYTES = 1_000_000


def decoder() -> Ld06Decoder:
    return Ld06Decoder(LD06_POINTS_PER_S)


def fed(data: bytes, size: int = 97) -> tuple[Points, Ld06Decoder]:
    one = decoder()
    return join_points([one.feed(data[i : i + size]) for i in range(0, len(data), size)]), one


def test_checksum_of_the_catalogue_and_of_division() -> None:
    assert crc8(b"123456789") == 0xC3
    rng = random.Random(1)
    for _ in range(50):
        data = rng.randbytes(rng.randrange(60))
        assert crc8(data) == bitwise_crc(data)


def test_the_manuals_frame() -> None:
    points = decoder().feed(LD06_EXAMPLE)
    assert len(points) == 12
    assert points.range_m[0] == np.float32(0.224)
    assert points.intensity[0] == 228
    np.testing.assert_allclose(np.degrees(points.bearing_rad[[0, -1]]), [360.0 - 324.27, 360.0 - 334.70], atol=1e-9)
    assert (points.stamp_ms == 0x1A3A).all()
    assert points.before_end_s[0] == pytest.approx(10.43 / 2152, rel=1e-6), "2152 degrees a second"


def test_angles_run_clockwise_and_cross_zero() -> None:
    points = decoder().feed(ld06_frame(357.0, 2.5, [(1000 + k, 9) for k in range(12)]))
    np.testing.assert_allclose(np.degrees(points.bearing_rad), [3.0 - 0.5 * k for k in range(12)], atol=1e-9)
    assert (np.diff(points.bearing_rad) < 0.0).all(), "from left to right"


def test_no_return_and_weak_returns_are_unknown() -> None:
    frame = ld06_frame(0.0, 8.8, [(0, 0), (500, 5), (500, 20)] + [(700, 99)] * 9)
    assert np.isnan(decoder().feed(frame).range_m).tolist() == [True] + [False] * 11
    strict = Ld06Decoder(LD06_POINTS_PER_S, min_intensity=10)
    assert np.isnan(strict.feed(frame).range_m).tolist() == [True, True] + [False] * 10


CHECKSUM_54 = [
    *[(470, 207), (223, 239), (223, 239), (4392, 216), (608, 77), (1611, 147)],
    *[(15981, 227), (15981, 227), (1881, 21), (5108, 189), (8846, 152), (986, 36)],
]
"""A frame whose checksum is the byte that begins a header."""


@example(CHECKSUM_54, 0.5, 0.5, 1670, [1])
@given(
    st.lists(st.tuples(st.integers(0, 65535), st.integers(0, 255)), min_size=12, max_size=12),
    st.floats(0.0, 359.9),
    st.floats(0.5, 11.0),
    st.integers(0, 29999),
    st.lists(st.integers(1, 60), min_size=1, max_size=20),
)
@settings(max_examples=60, deadline=None)
def test_any_frames_in_any_chunks(
    values: list[tuple[int, int]], start_deg: float, span_deg: float, stamp_ms: int, cuts: list[int]
) -> None:
    data = ld06_frame(start_deg, start_deg + span_deg, values, stamp_ms) * 3
    one, parts, place, turn = decoder(), [], 0, 0
    while place < len(data):
        step = cuts[turn % len(cuts)]
        parts.append(one.feed(data[place : place + step]))
        place, turn = place + step, turn + 1
    points = join_points(parts)
    expected = [np.nan if mm == 0 else mm / 1000.0 for mm, _ in values] * 3
    np.testing.assert_allclose(points.range_m, expected, rtol=1e-6)
    assert (points.stamp_ms == stamp_ms).all()
    assert (one.bad_checksums, one.bad_frames, one.buffered_bytes) == (0, 0, 0)


def test_bytes_behind_tell_how_long_ago_a_frame_came() -> None:
    frames = ld06_turn(lambda angle: 1000)[:3]
    points = decoder().feed(b"".join(frames) + b"\x54\x2c\x00")
    assert sorted(set(points.bytes_behind.tolist())) == [3, 50, 97]
    assert points.bytes_behind[0] == 97


def test_no_single_flipped_bit_gives_a_point_of_that_frame() -> None:
    frame = ld06_frame(10.0, 18.8, [(1000 + k, 200) for k in range(12)])
    for bit in range(8 * FRAME_BYTES):
        broken = bytearray(frame)
        broken[bit // 8] ^= 1 << bit % 8
        assert len(decoder().feed(bytes(broken))) == 0


def test_a_cut_frame_costs_only_itself_and_a_header_inside_data_nothing() -> None:
    frames = ld06_turn(lambda angle: 0x2C54)  # every distance looks like the header
    points, one = fed(frames[0] + frames[1][:20] + b"".join(frames[2:5]))
    assert len(points) == 4 * 12
    assert one.bad_checksums >= 1


def test_frames_glued_together_are_refused() -> None:
    too_wide = ld06_frame(0.0, 120.0, [(1000, 200)] * 12)
    still = ld06_frame(0.0, 0.0, [(1000, 200)] * 12, speed_deg_s=0)
    impossible = bytearray(ld06_frame(0.0, 8.0, [(1000, 200)] * 12)[:-1])
    impossible[4:6] = b"\xff\xff"
    for frame in (too_wide, still, bytes(impossible) + bytes([bitwise_crc(bytes(impossible))])):
        one = decoder()
        assert len(one.feed(frame)) == 0
        assert one.bad_frames == 1
    narrow = ld06_frame(0.0, 8.8, [(1000, 200)] * 12)
    assert len(Ld06Decoder(STL27L_POINTS_PER_S).feed(narrow)) == 0, "an STL-27L sweeps two degrees a frame"


def mutated(rng: random.Random, clean: bytes) -> bytes:
    """Flips, losses, insertions and repeats, a few per kilobyte."""
    data = bytearray(clean)
    for _ in range(max(1, len(data) // 200)):
        place = rng.randrange(len(data))
        kind = rng.randrange(5)
        if kind == 0:
            data[place] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[place : place + rng.randrange(1, 60)]
        elif kind == 2:
            data[place:place] = rng.randbytes(rng.randrange(1, 60))
        elif kind == 3:
            data[place:place] = data[place : place + rng.randrange(1, 100)]
        else:
            data[place : place + 2] = b"\x54\x2c"
        if not data:
            data += b"\0"
    return bytes(data)


def good_frames(data: bytes) -> list[bytes]:
    """Every place in a byte stream where a frame with a right checksum stands, found without the decoder."""
    places = [i for i in range(len(data) - 46) if data[i] == 0x54 and data[i + 1] == 0x2C]
    return [data[i : i + 47] for i in places if bitwise_crc(data[i : i + 46]) == data[i + 46]]


def test_a_million_mutated_bytes_raise_nothing_and_every_point_has_a_right_checksum() -> None:
    rng = random.Random(6)
    seen = points_seen = 0
    one = decoder()
    while seen < MUTATED_BYTES:
        clean = b"".join(ld06_turn(lambda angle: rng.randrange(1, 12000), first_s=rng.random(), seconds=0.2))
        data, place = mutated(rng, clean), 0
        allowed = set()
        for frame in good_frames(bytes(one._buffer) + data):
            allowed |= {int.from_bytes(frame[k : k + 2], "little") for k in range(6, 42, 3)}
        while place < len(data):
            size = rng.choice((1, 7, 46, 47, 48, 300, 4000))
            points = one.feed(data[place : place + size])
            place += size
            assert one.buffered_bytes < FRAME_BYTES
            measured = points.range_m[~np.isnan(points.range_m)]
            assert {round(float(v) * 1000) for v in measured} <= allowed
            points_seen += len(points)
        seen += len(data)
    assert points_seen > 0.25 * 12 * MUTATED_BYTES / FRAME_BYTES, "most frames were not hit and came through"
    assert one.bad_checksums > 1000


def test_pure_noise_gives_nothing_worth_a_scan() -> None:
    rng = random.Random(3)
    one = decoder()
    points = sum(len(one.feed(rng.randbytes(4096))) for _ in range(64))
    assert points <= 24, "a checksum of eight bits lets one header in 256 through"
    assert one.buffered_bytes < FRAME_BYTES


def test_a_flood_is_cut_and_does_not_grow() -> None:
    one = decoder()
    one.feed(b"\x54" * 10_000_000)
    assert one.buffered_bytes <= FRAME_BYTES
    assert one.bad_frames == 1
