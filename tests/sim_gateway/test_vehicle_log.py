"""The vehicle's own log: what is in it by an independent reader (pyulog), and how a client gets it."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from mavlink_bench import Bench
from pymavlink.dialects.v20 import development as mav
from pyulog import ULog

from sim_gateway import vehicle_log

PIECE = 90


@pytest.fixture
def flown() -> Iterator[Bench]:
    """A vehicle that has taken off, hovered and landed once."""
    bench = Bench()
    bench.run(3.5)
    fly(bench)
    yield bench
    bench.close()


def fly(bench: Bench) -> None:
    assert bench.acks(400, 1) == [0]
    bench.pilot.takeoff()
    bench.run(8.0)
    bench.pilot.land()
    while bench.pilot.armed:
        bench.run(0.5)


def entries(bench: Bench) -> list[Any]:
    bench.onboard.seen.clear()
    bench.onboard.send(mav.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF))
    bench.run(0.05)
    return bench.onboard.named("LOG_ENTRY")


def fetched(bench: Bench, number: int, offset: int = 0, count: int = 0xFFFFFFFF) -> bytes:
    bench.onboard.seen.clear()
    bench.onboard.send(mav.MAVLink_log_request_data_message(1, 1, number, offset, count))
    bench.run(2.0)
    data, position = b"", offset
    for piece in bench.onboard.named("LOG_DATA"):
        assert (piece.id, piece.ofs) == (number, position)
        data += bytes(piece.data[: piece.count])
        position += piece.count
    return data


def test_an_independent_reader_finds_the_flight(flown: Bench) -> None:
    (entry,) = entries(flown)
    data = fetched(flown, entry.id)
    assert len(data) == entry.size
    log = ULog(io.BytesIO(data))
    assert not log.file_corruption
    assert log.msg_info_dict["sys_name"] == "sim-gateway"
    position, status = log.get_dataset("vehicle_local_position").data, log.get_dataset("vehicle_status").data
    assert np.allclose(np.diff(position["timestamp"])[:-1], 1e5, atol=2e4), "10 Hz"
    assert -2.8 < position["z"].min() < -2.0, "takeoff height 2.5 m"
    assert abs(position["z"][-1]) < 0.1
    assert {17, 18} <= set(status["nav_state"]), "takeoff and landing"
    assert status["arming_state"].tolist() == [2] * (len(status["arming_state"]) - 1) + [1]
    assert [text.message for text in log.logged_messages][-1] in ("mode AUTO.LAND", "mode AUTO.LOITER")


def test_pieces_can_be_asked_for_again(flown: Bench) -> None:
    (entry,) = entries(flown)
    whole = fetched(flown, entry.id)
    assert fetched(flown, entry.id, 3 * PIECE, 2 * PIECE) == whole[3 * PIECE : 5 * PIECE]
    assert fetched(flown, entry.id, 100, 7) == whole[100:107]


def test_past_the_end_comes_one_empty_piece_and_an_unknown_log_is_silence(flown: Bench) -> None:
    (entry,) = entries(flown)
    assert fetched(flown, entry.id, entry.size + 1000) == b""
    flown.onboard.seen.clear()
    flown.onboard.send(mav.MAVLink_log_request_data_message(1, 1, entry.id, entry.size + 1000, 90))
    flown.run(0.1)
    assert [piece.count for piece in flown.onboard.named("LOG_DATA")] == [0]
    assert fetched(flown, 77) == b""


def test_end_stops_the_data(flown: Bench) -> None:
    (entry,) = entries(flown)
    flown.onboard.seen.clear()
    flown.onboard.send(mav.MAVLink_log_request_data_message(1, 1, entry.id, 0, entry.size))
    flown.run(0.004)
    flown.onboard.send(mav.MAVLink_log_request_end_message(1, 1))
    flown.run(1.0)
    assert 0 < len(flown.onboard.named("LOG_DATA")) * PIECE < entry.size


def test_erased_logs_are_gone_and_a_vehicle_without_flights_says_so(flown: Bench) -> None:
    assert len(entries(flown)) == 1
    flown.onboard.send(mav.MAVLink_log_erase_message(1, 1))
    flown.run(0.05)
    (entry,) = entries(flown)
    assert (entry.num_logs, entry.size) == (0, 0)


def test_a_log_that_grows_is_served_as_long_as_it_was_when_listed(flown: Bench) -> None:
    assert flown.acks(400, 1) == [0]
    flown.run(1.0)
    listed = entries(flown)[-1]
    flown.run(2.0)
    flown.onboard.send(mav.MAVLink_log_erase_message(1, 1))
    flown.run(0.05)
    data = fetched(flown, listed.id)
    assert len(data) == listed.size, "and the flight under way outlives an erasing"
    assert ULog(io.BytesIO(data)).get_dataset("vehicle_status").data["arming_state"].tolist()[0] == 2


def test_memory_is_bounded(flown: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vehicle_log, "MAX_BYTES", 2000)
    for _ in range(vehicle_log.MAX_LOGS + 1):
        assert flown.acks(400, 1) == [0]
        flown.run(6.0)
        flown.pilot.disarm(force=True)
        flown.run(0.1)
    listed = entries(flown)
    assert [entry.id for entry in listed] == [2, 3, 4, 5]
    assert max(entry.size for entry in listed) < 2000 + 200
