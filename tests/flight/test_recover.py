"""`fly recover`: whatever is cut off or damaged, what is left is saved, and nothing but an error in one line comes out."""

from __future__ import annotations

import io
import json
import random
import signal
import time
from pathlib import Path

import pytest
from mcap.reader import make_reader
from recorded_flight import record_lockstep
from stand import Program, Stand

from flight.errors import FlyError
from flight.recording_reader import Salvage, read_recording, salvaged_records
from flight.recording_schema import RecordingError
from flight.recover import recover
from flight.replay import compare


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, seeker_policy: Path) -> bytes:
    path = tmp_path_factory.mktemp("recording") / "flight.mcap"
    record_lockstep(path, seeker_policy, duration_s=6.0)
    return path.read_bytes()


def messages(data: bytes) -> list[tuple[str, int, bytes]]:
    """What Foxglove's own reader (needs the index) finds: topic, time, content, in the order of time."""
    with io.BytesIO(data) as file:
        reader = make_reader(file)
        assert reader.get_summary() is not None
        return [(channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()]


def recovered(folder: Path, data: bytes) -> bytes | None:
    """The recovered file of `data`; None where nothing could be recovered."""
    source, target = folder / "cut.mcap", folder / "out.mcap"
    source.write_bytes(data)
    target.unlink(missing_ok=True)
    try:
        result = recover(source, target)
    except RecordingError:
        assert not target.exists()
        return None
    assert source.read_bytes() == data
    return target.read_bytes() if result.output is not None else data


def test_a_whole_file_needs_nothing(tmp_path: Path, whole: bytes) -> None:
    (tmp_path / "flight.mcap").write_bytes(whole)
    result = recover(tmp_path / "flight.mcap")
    assert result.output is None
    assert result.lost_bytes == 0
    assert "nothing to recover" in result.describe()
    assert [path.name for path in tmp_path.iterdir()] == ["flight.mcap"]


def test_every_cut_saves_all_that_came_before(tmp_path: Path, whole: bytes) -> None:
    all_messages = messages(whole)
    random.seed(1)
    saved = []
    for length in sorted(random.sample(range(len(whole)), 40)):
        data = recovered(tmp_path, whole[:length])
        found = [] if data is None else messages(data)
        assert found == all_messages[: len(found)]
        saved.append(len(found))
    assert saved == sorted(saved)
    assert saved[0] == 0
    assert saved[-1] > 0.8 * len(all_messages)


@pytest.mark.parametrize("tail", [b"\x00" * 5000, b"\xff" * 5000, b"\x06" + b"\xff" * 8 + b"chunk"])
def test_a_tail_that_the_disk_never_wrote(tmp_path: Path, whole: bytes, tail: bytes) -> None:
    cut = whole[: len(whole) * 3 // 4]
    with_tail, without = recovered(tmp_path, cut + tail), recovered(tmp_path, cut)
    assert with_tail is not None
    assert without is not None
    assert messages(with_tail) == messages(without)


def test_a_damaged_chunk_costs_only_itself(tmp_path: Path, whole: bytes) -> None:
    """One wrong byte in the middle: the checksum finds it, the chunks before and after it are kept."""
    position = len(whole) * 3 // 4
    damaged = bytearray(whole)
    damaged[position] ^= 0x40
    data = recovered(tmp_path, bytes(damaged))
    assert data is not None
    before, after = set(messages(whole)), set(messages(data))
    assert after < before
    assert len(before - after) < 0.4 * len(before)  # a chunk is as long as it took to fill or to write: a third of a short flight


def test_no_damage_ends_in_anything_but_one_line(tmp_path: Path, whole: bytes) -> None:
    """Three hundred random mutations: read, recovered or refused by name. Never another exception, never a made-up message."""
    random.seed(2)
    genuine = {content for _, _, content in messages(whole)}
    for number in range(300):
        data = bytearray(whole[-150_000:] if number % 3 == 0 else whole)
        data[:8] = whole[:8]
        for _ in range(random.randint(1, 20)):
            data[random.randrange(8, len(data))] = random.randrange(256)
        salvage = Salvage()
        found = [r for r in salvaged_records(io.BytesIO(data), salvage) if type(r).__name__ == "Message"]
        assert {record.data for record in found} <= genuine
        if number % 30 == 0:
            recovered(tmp_path, bytes(data))


def test_an_existing_file_is_never_replaced(tmp_path: Path, whole: bytes) -> None:
    source = tmp_path / "flight.mcap"
    source.write_bytes(whole[:-100_000])
    (tmp_path / "flight-recovered.mcap").write_text("mine")
    with pytest.raises(FlyError, match="exists already: give another name with --out"):
        recover(source)
    assert (tmp_path / "flight-recovered.mcap").read_text() == "mine"


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "not an MCAP file"), (b"hello, world", "not an MCAP file"), (b"\x89MCAP0\r\n", "there is nothing to recover")],
)
def test_files_that_are_none(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "x.mcap").write_bytes(content)
    program = Program("flight", "recover", str(tmp_path / "x.mcap"))
    assert program.finish(60.0) == 2
    assert words in program.err
    assert program.err.count("\n") == 1


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"gone\.mcap"):
        recover(tmp_path / "gone.mcap")


# -- in flight ------------------------------------------------------------------------------------------------------


@pytest.mark.realtime
def test_sigkill_in_flight_keeps_all_but_the_last_second(tmp_path: Path, seeker_policy: Path) -> None:
    """The real program on the real gateway, killed in flight: recovered, readable by Foxglove's reader, replayed bit for bit."""
    stand = Stand(tmp_path, seeker_policy)
    program = stand.fly()
    try:
        program.wait_for("the policy flies", 150.0)
        time.sleep(3.0)
        program.process.send_signal(signal.SIGKILL)
        killed_ns = time.time_ns()
        program.process.wait(10.0)
    finally:
        program.stop()
    cut = tmp_path / "run" / "flight.mcap"
    assert not cut.read_bytes().endswith(b"\x89MCAP0\r\n")
    done = Program("flight", "recover", str(cut), "--json")
    assert done.finish(60.0) == 0, done.err
    report = json.loads(done.out)
    data = Path(report["output"]).read_bytes()
    ticks = [time_ns for topic, time_ns, _ in messages(data) if topic == "/replay/tick"]
    assert len(ticks) > 30
    assert killed_ns - ticks[-1] < 1.0e9
    result = compare(read_recording(Path(report["output"])))
    assert result.identical, result.first
    assert result.ticks == len(ticks)
    reported = Program("flight", "report", str(tmp_path / "run"))
    assert reported.finish(120.0) == 0, reported.err
    assert "broken off" in (tmp_path / "run" / "report.html").read_text()
    assert (tmp_path / "run" / "trajectory.png").is_file()


def test_replay_takes_a_cut_file_as_it_is(tmp_path: Path, whole: bytes) -> None:
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 4 // 5])
    program = Program("flight", "replay", str(tmp_path / "cut.mcap"), "--json")
    assert program.finish(60.0) == 0, program.err
    assert json.loads(program.out)["identical"] is True
    assert "fly recover makes it whole" in program.err


def test_a_file_cut_in_its_first_chunk_is_no_foreign_file(tmp_path: Path, whole: bytes) -> None:
    (tmp_path / "flight.mcap").write_bytes(whole[:200])
    with pytest.raises(RecordingError, match="the file ends within a record, before its first whole chunk"):
        read_recording(tmp_path / "flight.mcap")
