"""`fly replay`: a committed recording through today's runner and safety filter, bit for bit; every difference is found."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_flight import record_lockstep
from stand import Program

from flight.recorder import Recorder
from flight.recording_config import RecordingConfig
from flight.recording_reader import Recording, read_recording
from flight.recording_schema import RecordingError, this_machine
from flight.replay import compare, compare_policy, pilot_of, recorded_policy
from safety.config import SafetyConfig
from safety.frames import CorridorVector

COMMITTED = Path(__file__).parents[1] / "data" / "corridor_seed1.mcap"
OTHER_PROCESSOR = 1e-4
"""What another processor's rounding may do to the committed flight, m/s and the like."""


@pytest.fixture
def committed() -> Recording:
    return read_recording(COMMITTED)


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory, seeker_policy: Path) -> Path:
    """Made on this machine, by a policy that flies at obstacles: what is compared here is compared in every bit."""
    path = tmp_path_factory.mktemp("recording") / "flight.mcap"
    record_lockstep(path, seeker_policy, seed=1, duration_s=12.0)
    return path


def with_sample(recording: Recording, index: int, **changes: Any) -> Recording:
    recording.ticks[index] = dataclasses.replace(recording.ticks[index], **changes)
    return recording


def test_the_committed_recording_replays(committed: Recording) -> None:
    """In every bit where processor and libraries are those it was made with, elsewhere within rounding."""
    exact = this_machine().computes_like(committed.header.machine)
    result = compare(committed, 0.0 if exact else OTHER_PROCESSOR)
    assert result.identical, result.first
    assert result.ticks == 201
    assert result.same_machine is exact
    moving = [sample for sample in committed.ticks if sample.record.wanted is not None]
    assert len(moving) == 201
    assert max(sample.record.hidden_norm for sample in committed.ticks) > 1.0


def test_a_flight_with_interventions_replays_bit_for_bit(fresh: Path) -> None:
    recording = read_recording(fresh)
    rules = {i.rule for sample in recording.ticks for i in sample.record.verdict.interventions}
    assert len(rules) >= 2, rules
    result = compare(recording)
    assert result.identical, result.first
    assert result.same_machine


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("hidden_norm", lambda r: dataclasses.replace(r, hidden_norm=math.nextafter(r.hidden_norm, 0.0))),
        (
            "sent.velocity.y",
            lambda r: dataclasses.replace(
                r, sent=dataclasses.replace(r.sent, velocity=dataclasses.replace(r.sent.velocity, y=-r.sent.velocity.y))
            ),
        ),
        ("wanted.velocity.x", lambda r: dataclasses.replace(r, wanted=None)),
        ("verdict.braking", lambda r: dataclasses.replace(r, verdict=dataclasses.replace(r.verdict, braking=True))),
        (
            "verdict.interventions.length",
            lambda r: dataclasses.replace(r, verdict=dataclasses.replace(r.verdict, interventions=())),
        ),
        ("goal_reached", lambda r: dataclasses.replace(r, goal_reached=True)),
    ],
)
def test_the_first_difference_is_named(fresh: Path, name: str, change: Any) -> None:
    recording = read_recording(fresh)
    disturbed = [k for k, sample in enumerate(recording.ticks) if sample.record.verdict.interventions]
    index = disturbed[len(disturbed) // 2]
    result = compare(with_sample(recording, index, record=change(recording.ticks[index].record)))
    assert not result.identical
    assert result.differing_ticks == 1
    assert result.first is not None
    assert result.first.tick == index
    assert name in result.fields
    assert f"tick {index}" in result.first.describe()


def test_inference_time_is_not_compared(fresh: Path) -> None:
    recording = read_recording(fresh)
    slow = dataclasses.replace(recording.ticks[5].record, inference_s=9.0)
    assert compare(with_sample(recording, 5, record=slow)).identical


def test_a_beam_read_otherwise_shows_in_the_memory_first(fresh: Path) -> None:
    """One beam, one scan: the policy sees it, so the tick of that scan is the first to differ."""
    recording = read_recording(fresh)
    scan = recording.ticks[40].scan
    assert scan is not None
    ranges = scan.ranges_m.copy()
    ranges[170:190] = 0.4
    changed = with_sample(recording, 40, scan=dataclasses.replace(scan, ranges_m=ranges))
    result = compare(changed)
    assert result.first is not None
    assert result.first.tick == 40


def test_a_changed_safety_limit_shows(fresh: Path) -> None:
    recording = read_recording(fresh)
    safety = recording.header.safety
    slower = SafetyConfig.model_validate({**safety.model_dump(), "max_horizontal_speed_m_s": 0.5})
    recording.header = recording.header.model_copy(update={"safety": slower})
    result = compare(recording)
    assert not result.identical
    assert result.first is not None
    assert result.first.field.startswith(("sent.", "verdict."))


def test_missing_and_broken_samples_replay_bit_for_bit(tmp_path: Path, committed: Recording) -> None:
    """No scan, no state, NaN, a stale scan, a clock that jumps, nothing sent: recorded and refused again in the same way."""
    path, policy = tmp_path / "flight.mcap", recorded_policy(committed)
    pilot = pilot_of(committed, policy)
    assert committed.policy is not None
    with Recorder(path, committed.header, committed.policy, RecordingConfig()) as recorder:
        for sample in committed.ticks[:80]:
            scan, state, now_s = sample.scan, sample.state, sample.record.now_s
            assert scan is not None
            assert state is not None
            match sample.tick:
                case 10 | 11:
                    scan = None
                case 20:
                    state = None
                case 30:
                    state = dataclasses.replace(state, yaw_rad=math.nan, velocity=CorridorVector(math.inf, 0.0, -0.0))
                case 40:
                    scan = dataclasses.replace(scan, ranges_m=np.full_like(scan.ranges_m, np.nan))
                case 50:
                    scan = dataclasses.replace(scan, time_s=scan.time_s - 5.0)
                case 60:
                    now_s += 7.0
            record = pilot.tick(scan, state, now_s)
            sent = None if sample.tick == 70 else record.sent
            recorder.tick(record, scan, state, sent, math.nan if sent is None else now_s, pilot.goal)
    recording = read_recording(path)
    faults = {sample.record.verdict.fault for sample in recording.ticks}
    assert len(faults) >= 5, faults
    result = compare(recording)
    assert result.identical, result.first
    assert result.ticks == 80


def test_comparison_ends_at_a_missing_tick(fresh: Path) -> None:
    recording = read_recording(fresh)
    del recording.ticks[100]
    result = compare(recording)
    assert result.ticks == 100
    assert result.first is None
    assert not result.identical
    assert result.missing_ticks == len(recording.ticks) + 1 - 100


def test_a_policy_that_is_not_the_one_that_flew_is_refused(committed: Recording) -> None:
    assert committed.policy is not None
    committed.policy = committed.policy[:-1] + bytes([committed.policy[-1] ^ 1])
    with pytest.raises(RecordingError, match="not the one that flew"):
        recorded_policy(committed)
    committed.policy = None
    with pytest.raises(RecordingError, match="holds no policy"):
        recorded_policy(committed)


def test_a_recording_without_a_tick_says_so(committed: Recording) -> None:
    committed.ticks.clear()
    with pytest.raises(RecordingError, match="no tick"):
        compare(committed)


def test_another_policy_on_the_same_inputs(committed: Recording, seeker_policy: Path, tmp_path: Path) -> None:
    other = compare_policy(committed, seeker_policy, 20.0)
    assert other.compared == other.ticks == 201
    assert other.noticeable > 50
    assert other.first_tick is not None
    assert 0.05 < other.velocity_m_s["mean"] <= other.velocity_m_s["max"] < 2.0
    same = tmp_path / "same.onnx"
    assert committed.policy is not None
    same.write_bytes(committed.policy)
    itself = compare_policy(committed, same, 20.0)
    assert itself.noticeable == 0
    assert itself.velocity_m_s["max"] < OTHER_PROCESSOR


def test_the_command_says_same_different_and_unreadable(tmp_path: Path, fresh: Path, seeker_policy: Path) -> None:
    same = Program("flight", "replay", str(fresh))
    assert same.finish(60.0) == 0, same.err
    assert "the same bit for bit" in same.out
    other = Program("flight", "replay", str(COMMITTED), "--policy", str(seeker_policy), "--json")
    assert other.finish(60.0) == 0, other.err
    assert json.loads(other.out)["first_tick"] is not None
    missing = Program("flight", "replay", str(COMMITTED), "--policy", str(tmp_path / "gone.onnx"))
    assert missing.finish(60.0) == 2
    assert "gone.onnx" in missing.err
    assert missing.err.count("\n") == 1


def test_a_tampered_file_ends_with_exit_code_1_and_the_first_difference(tmp_path: Path, fresh: Path) -> None:
    """The recorded command of one tick is changed in the file itself (written anew, so that every checksum is right)."""
    tampered = tmp_path / "tampered.mcap"
    _rewrite(fresh, tampered, tick=33)
    program = Program("flight", "replay", str(tampered), "--json")
    assert program.finish(60.0) == 1, program.err
    result = json.loads(program.out)
    assert result["first"]["tick"] == 33
    assert result["first"]["field"] == "hidden_norm"
    assert result["first"]["recorded"] == 42.0


def _rewrite(source: Path, target: Path, tick: int) -> None:
    from mcap.reader import make_reader
    from mcap.writer import Writer

    shutil.copy(source, target)
    with source.open("rb") as file, target.open("wb") as sink:
        writer = Writer(sink)
        writer.start()
        reader = make_reader(file)
        ids: dict[int, int] = {}
        for attachment in reader.iter_attachments():
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)
        for schema, channel, message in reader.iter_messages():
            if channel.id not in ids:
                assert schema is not None
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            data = message.data
            if channel.topic == "/replay/tick" and json.loads(data)["tick"] == tick:
                document = json.loads(data)
                document["record"]["hidden_norm"] = 42.0
                data = json.dumps(document).encode()
            writer.add_message(ids[channel.id], message.log_time, data, message.publish_time)
        writer.finish()


def test_float32_ranges_and_float64_states_are_exact(committed: Recording) -> None:
    sample = committed.ticks[50]
    assert sample.scan is not None
    assert sample.scan.ranges_m.dtype == np.float32
    assert len(sample.scan.ranges_m) == 361
    assert sample.record.scan_time_s == sample.scan.time_s
