"""SCIP decoder: published vectors, round trips through an independent encoder, damage, garbage, bounded memory."""

from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scip_peer import BEAMS, STREAM_ECHO, character_sum, encode, parameter_lines, reply, scan_message, summed

from flight.lidar import scip

SENT = scip.stream_request(180, 540)
VALUES = [(i * 37) % 4001 for i in range(BEAMS)]


def decode(message: bytes, beams: int = BEAMS) -> scip.ScipScan:
    (only,) = scip.ReplyReader().feed(message)
    return scip.decode_scan(only, SENT, beams)


def scans_in(data: bytes, beams: int = BEAMS) -> list[scip.ScipScan]:
    found = []
    for one in scip.ReplyReader().feed(data):
        try:
            found.append(scip.decode_scan(one, SENT, beams))
        except scip.ScipError:
            continue
    return found


@pytest.mark.parametrize(("line", "character"), [("00", "P"), ("99", "b"), ("02", "R"), ("0E", "e")])
def test_checksums_of_the_manual(line: str, character: str) -> None:
    assert chr(scip.checksum(line.encode())) == character


@pytest.mark.parametrize(("characters", "value"), [(b"CB", 1234), (b"1Dh", 5432), (b"m2@0", 16_000_000)])
def test_numbers_of_the_manual(characters: bytes, value: int) -> None:
    assert scip.decode_number(characters) == value


def test_requests_on_the_wire() -> None:
    assert SENT == b"MD01800540" + b"01" + b"0" + b"00" + b"\n"
    assert scip.request("TM", "1") == b"TM1\n"
    with pytest.raises(scip.ScipError):
        scip.stream_request(540, 180)


def test_a_scan_comes_back_as_sent() -> None:
    scan = decode(scan_message(VALUES, 16_777_215))
    assert scan.values_mm.tolist() == VALUES
    assert scan.timestamp_ms == 16_777_215


@given(
    st.lists(st.integers(0, 2**18 - 1), min_size=1, max_size=400),
    st.integers(0, 2**24 - 1),
    st.lists(st.integers(1, 200), min_size=1, max_size=40),
)
@settings(max_examples=60, deadline=None)
def test_any_scan_in_any_chunks(values: list[int], timestamp_ms: int, cuts: list[int]) -> None:
    data = reply(STREAM_ECHO + "00", "00") + scan_message(values, timestamp_ms) + scan_message(values, timestamp_ms)
    reader, replies, place, turn = scip.ReplyReader(), [], 0, 0
    while place < len(data):
        step = cuts[turn % len(cuts)]
        replies += reader.feed(data[place : place + step])
        place, turn = place + step, turn + 1
    assert [r.status for r in replies] == ["00", "99", "99"]
    for one in replies[1:]:
        scan = scip.decode_scan(one, SENT, len(values))
        assert (scan.values_mm.tolist(), scan.timestamp_ms) == (values, timestamp_ms)
    assert reader.buffered_bytes == 0
    assert (reader.bad_checksums, reader.bad_frames) == (0, 0)


def test_no_single_flipped_bit_gives_a_different_scan() -> None:
    values = VALUES[:50]
    message = scan_message(values, 123_456)
    for place in range(len(message)):
        for bit in range(8):
            damaged = bytearray(message)
            damaged[place] ^= 1 << bit
            for scan in scans_in(bytes(damaged), beams=50):
                assert (scan.values_mm.tolist(), scan.timestamp_ms) == (values, 123_456), (place, bit)


def frame_is_sound(frame: bytes, beams: int) -> bool:
    """The protocol's rules once more, by the tests' own encoder."""
    lines = frame.decode("latin-1").split("\n")
    if len(lines) < 4 or lines[1] != "99b" or lines[0][:-2] != STREAM_ECHO or any(len(line) < 2 for line in lines):
        return False
    inside = all("0" <= letter <= "o" for line in lines[1:] for letter in line)
    sums = all(character_sum(line[:-1]) == line[-1] for line in lines[1:])
    return inside and sums and sum(len(line) - 1 for line in lines[3:]) == 3 * beams


@given(st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 7)), min_size=1, max_size=12))
@settings(max_examples=150, deadline=None)
def test_flipped_bits_never_give_a_scan_with_a_bad_checksum(flips: list[tuple[int, int]]) -> None:
    damaged = bytearray(scan_message(VALUES[:60], 99) * 2)
    for place, bit in flips:
        damaged[place % len(damaged)] ^= 1 << bit
    sound = [frame for frame in bytes(damaged).split(b"\n\n") if frame_is_sound(frame.lstrip(b"\n"), 60)]
    assert len(scans_in(bytes(damaged), beams=60)) <= len(sound)


@given(st.lists(st.binary(max_size=3000), max_size=20))
@settings(max_examples=60, deadline=None)
def test_random_bytes_never_raise_never_grow_never_give_a_scan(chunks: list[bytes]) -> None:
    reader = scip.ReplyReader()
    for chunk in chunks:
        for one in reader.feed(chunk):
            with pytest.raises(scip.ScipError):
                scip.decode_scan(one, SENT, BEAMS)
        assert reader.buffered_bytes <= scip.MAX_REPLY_BYTES


def test_a_million_mutated_bytes() -> None:
    rng = random.Random(11)
    reader = scip.ReplyReader()
    message = scan_message(VALUES, 77)
    mutated = good = 0
    while mutated < 1_000_000:
        damaged = bytearray(message)
        for _ in range(rng.choice((0, 1, 3, len(damaged)))):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
            mutated += 1
        for one in reader.feed(bytes(damaged)):
            try:
                scan = scip.decode_scan(one, SENT, BEAMS)
            except scip.ScipError:
                continue
            good += 1
            assert scan.values_mm.size == BEAMS
        assert reader.buffered_bytes <= scip.MAX_REPLY_BYTES
    assert good > 100  # the undamaged ones between the others are found again


def test_an_endless_line_is_dropped_and_the_next_scan_found() -> None:
    reader = scip.ReplyReader()
    for _ in range(200):
        assert reader.feed(b"x" * 1000) == []
        assert reader.buffered_bytes <= scip.MAX_REPLY_BYTES
    assert reader.bad_frames == 1
    reader.feed(b"\n\n")
    (one,) = reader.feed(scan_message(VALUES, 5))
    assert scip.decode_scan(one, SENT, BEAMS).timestamp_ms == 5


def test_a_half_frame_costs_no_more_than_the_frame_it_runs_into() -> None:
    whole = scan_message(VALUES, 5)
    assert len(scans_in(whole[:700] + whole + whole)) == 1


@pytest.mark.parametrize(
    "message",
    [
        scan_message(VALUES[:-1], 5),
        scan_message([*VALUES, 1], 5),
        scan_message(VALUES, 5, echo="MD0179054001000"),
        scan_message(VALUES, 5, echo=STREAM_ECHO + "0x"),
        scan_message(VALUES, 5, status="00"),
        reply(STREAM_ECHO + "00", "99"),
        reply(STREAM_ECHO + "00", "99", [summed(encode(1, 3))]),
    ],
    ids=["one beam short", "one beam more", "other steps", "no number", "status", "no data", "short timestamp"],
)
def test_a_scan_that_is_not_the_one_asked_for_is_refused(message: bytes) -> None:
    with pytest.raises(scip.ScipError):
        decode(message)


def test_codes_become_what_they_mean() -> None:
    values = np.array([0, 1, 2, 3, 99, 100, 4000, 4001, 65_535], dtype=np.int32)
    ranges = scip.ranges_from_values(values, 100, 4000)
    expected = [np.nan, np.inf, 0.0, np.nan, np.nan, 0.1, 4.0, np.inf, np.inf]
    np.testing.assert_allclose(ranges, np.array(expected, dtype=np.float32), rtol=1e-6)
    assert ranges.dtype == np.float32


def test_parameters_and_geometry() -> None:
    (one,) = scip.ReplyReader().feed(reply("PP", "00", parameter_lines()))
    parameters = scip.decode_parameters(one)
    assert parameters.beams == BEAMS
    assert parameters.angle_min_rad == pytest.approx(-np.pi / 2)
    assert parameters.angle_min_rad + (BEAMS - 1) * parameters.angle_increment_rad == pytest.approx(np.pi / 2)


def test_information_lines_may_count_the_semicolon_in_their_sum() -> None:
    lines = [line[:-1] + character_sum(line[:-1]) for line in parameter_lines()]
    (one,) = scip.ReplyReader().feed(reply("PP", "00", lines))
    assert scip.decode_parameters(one).steps_per_turn == 720


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("ARES", 0),
        ("ARES", 100),
        ("AMAX", 180),
        ("AMIN", -1),
        ("AFRT", 9000),
        ("DMIN", 0),
        ("DMAX", 99),
        ("DMAX", 10**9),
        ("SCAN", 0),
        ("SCAN", "1e3"),
        ("AMAX", "٣٤٥"),
    ],
)
def test_impossible_parameters_are_refused(field: str, value: object) -> None:
    lines = [line.encode("utf-8").decode("latin-1") for line in parameter_lines()]
    changed = f"{field}:{value}".encode().decode("latin-1")
    lines = [changed + ";" + character_sum(changed) if line.startswith(field) else line for line in lines]
    (one,) = scip.ReplyReader().feed(reply("PP", "00", lines))
    with pytest.raises(scip.ScipError):
        scip.decode_parameters(one)


def test_a_clock_reply() -> None:
    (one,) = scip.ReplyReader().feed(reply("TM1", "00", [summed(encode(16_000_000, 4))]))
    assert scip.decode_clock(one) == 16_000_000
    (other,) = scip.ReplyReader().feed(reply("TM1", "04"))
    with pytest.raises(scip.ScipError):
        scip.decode_clock(other)
