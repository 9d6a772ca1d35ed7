"""The metadata models: every layout they accept is whole, everything else is refused with the field's name."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from policy_export.contract import (
    ActionLayout,
    ChannelSpec,
    LidarSpec,
    ObservationLayout,
    PolicyMetadata,
    ResetRules,
    VerificationRecord,
    default_layout,
    foreign_fields,
    paper_layout,
    parse_metadata,
    training_record,
)
from policy_export.errors import PolicyFileError
from policy_export.observation import ObservationBuilder

VERIFICATION = VerificationRecord(
    steps=1000,
    resets=9,
    batch=8,
    seed=0,
    reference="torch",
    runtime="ort",
    tolerance=1e-5,
    max_action_difference=0,
    max_abs_difference=1e-6,
)


def metadata(**changes: object) -> PolicyMetadata:
    values: dict[str, object] = {
        "observation": default_layout(),
        "action": ActionLayout(),
        "memory": "lstm",
        "hidden_size": 128,
        "verification": VERIFICATION,
        "weights_sha256": "0" * 64,
    }
    return PolicyMetadata.model_validate(values | changes)


def document(**changes: object) -> str:
    values = json.loads(metadata().to_json())
    values.update(changes)
    return json.dumps(values)


def test_default_layout_is_the_papers_190() -> None:
    layout = default_layout()
    assert layout.size == 190
    spans = [(c.name, c.start, c.stop) for c in layout.channels]
    assert spans == [
        ("lidar", 0, 180),
        ("goal_offset", 180, 183),
        ("velocity", 183, 186),
        ("acceleration", 186, 189),
        ("yaw", 189, 190),
    ]
    assert layout.lidar == LidarSpec(beams=180, fov_rad=math.pi, range_min_m=0.1, range_max_m=4.0)
    assert paper_layout().channel("velocity").frame == "corridor"  # type: ignore[union-attr]


@given(
    beams=st.integers(1, 512),
    order=st.permutations(["lidar", "goal_offset", "position", "velocity", "acceleration", "yaw"]),
    count=st.integers(1, 6),
    shift=st.integers(-2, 2),
)
def test_a_layout_is_accepted_exactly_when_it_covers_its_size(beams: int, order: list[str], count: int, shift: int) -> None:
    frames = {"lidar": "sensor", "yaw": "corridor", "position": "corridor"}
    units = {"velocity": "m/s", "acceleration": "m/s^2", "yaw": "rad"}
    channels, start = [], 0
    for name in order[:count]:
        stop = start + {"lidar": beams, "yaw": 1}.get(name, 3)
        channels.append(
            {"name": name, "unit": units.get(name, "m"), "frame": frames.get(name, "heading"), "start": start, "stop": stop}
        )
        start = stop
    whole = {"size": start + shift, "lidar": {"beams": beams}, "channels": channels}
    if shift == 0:
        assert ObservationLayout.model_validate(whole).size == start
        return
    with pytest.raises(ValidationError):
        ObservationLayout.model_validate(whole)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": 1, "stop": 4}, "must start at 0"),
        ({"stop": 4}, "must hold 3 values"),
        ({"unit": "m"}, "unit of velocity"),
        ({"frame": "sensor"}, "frame of velocity"),
    ],
)
def test_a_wrong_channel_says_what_is_wrong(change: dict[str, object], message: str) -> None:
    channel = {"name": "velocity", "unit": "m/s", "frame": "heading", "start": 0, "stop": 3} | change
    with pytest.raises(ValidationError, match=message):
        ObservationLayout.model_validate({"size": 3, "lidar": {}, "channels": [channel]})


def test_channels_may_not_repeat() -> None:
    channels = [ChannelSpec(name="velocity", unit="m/s", frame="heading", start=k, stop=k + 3) for k in (0, 3)]
    with pytest.raises(ValidationError, match="appears twice"):
        ObservationLayout(size=6, lidar=LidarSpec(), channels=tuple(channels))


@pytest.mark.parametrize("low", [(1.0, -0.5, -0.5, -1.0), (-51.0, -0.5, -0.5, -1.0), (math.nan, -0.5, -0.5, -1.0)])
def test_impossible_action_limits_are_refused(low: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValidationError):
        ActionLayout(low=low)


def test_metadata_survives_the_file() -> None:
    original = metadata(evaluation={"success": {"rate": 0.97, "n": 200}}, reset=ResetRules(max_gap_s=0.3))
    assert parse_metadata(original.to_json()) == original


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("{", "metadata"),
        ("[]", "metadata"),
        ("[" * 100_000, "metadata"),
        ('{"schema_version": 1, "schema_version": 1}', "metadata"),
        (document(schema_version=2), "metadata.schema_version"),
        (document(rate_hz=-1), "metadata.rate_hz"),
        (document().replace("20.0", "NaN"), "metadata"),
        (document(surprise=1), "metadata.surprise"),
        (document(hidden_size=0), "metadata.document"),
        (document(weights_sha256="xyz"), "metadata.weights_sha256"),
        (document(action={"frame": "ned", "low": [0, 0, 0, 0], "high": [1, 1, 1, 1]}), "metadata.action.frame"),
    ],
)
def test_bad_metadata_names_the_field(text: str, field: str) -> None:
    with pytest.raises(PolicyFileError) as caught:
        parse_metadata(text)
    assert caught.value.field == field
    assert "\n" not in str(caught.value)


def test_metadata_that_would_swell_the_file_is_refused() -> None:
    with pytest.raises(PolicyFileError, match="larger than"):
        metadata(evaluation={"everything": "x" * 300_000}).to_json()


def test_unknown_training_keys_are_kept_as_details() -> None:
    record = training_record({"seed": 1, "preset": "tuned"})
    assert (record.seed, record.details) == (1, {"preset": "tuned"})


def test_a_record_of_a_failed_verification_cannot_exist() -> None:
    with pytest.raises(ValidationError, match="exceeds the tolerance"):
        VerificationRecord.model_validate(VERIFICATION.model_dump() | {"max_abs_difference": 1e-4})


def other(size: int = 2, **changes: object) -> dict[str, object]:
    return {"name": "other_wind", "unit": "m/s", "frame": "none", "start": 0, "stop": size} | changes


def test_other_channels_are_carried_with_any_width_and_named_as_foreign() -> None:
    layout = ObservationLayout.model_validate({"size": 2, "channels": [other()]})
    assert layout.lidar == LidarSpec()
    found = metadata(observation=layout)
    assert parse_metadata(found.to_json()) == found
    assert foreign_fields(found) == ["observation.channels.0.name other_wind"]
    assert foreign_fields(metadata()) == []
    with pytest.raises(PolicyFileError, match=r"channels\.0\.name"):
        ObservationBuilder(layout)


@pytest.mark.parametrize("change", [{"name": "wind"}, {"name": "otherwind"}, {"unit": ""}, {"start": 2}, {"frame": "ned"}])
def test_a_channel_is_either_known_or_called_other(change: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        ObservationLayout.model_validate({"size": 2, "channels": [other() | change]})


def test_an_action_of_another_kind_is_foreign() -> None:
    torque = ActionLayout(frame="none", names=("other_torque",), low=(-200.0,), high=(200.0,))
    assert foreign_fields(metadata(action=torque)) == ["action.names other_torque"]


@pytest.mark.parametrize(
    "change",
    [
        {"names": ("vx", "vy")},
        {"names": ("vx", "vy", "vz", "other")},
        {"names": ("other", "other", "other_a", "other_b"), "frame": "none"},
        {"names": ("other",), "frame": "none"},
        {"frame": "none"},
        {"names": ("other_a", "other_b", "other_c", "other_d")},
        {"low": (0.0, -0.5, -0.5), "high": (1.0, 0.5, 0.5)},
        {"low": (0.2, -0.5, -0.5, -1.0), "high": (0.2, 0.5, 0.5, 1.0)},
    ],
)
def test_an_action_is_a_whole_velocity_command_or_called_other(change: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        ActionLayout.model_validate(change)


def test_an_axis_that_is_not_used_is_fixed_at_zero() -> None:
    assert ActionLayout(low=(-0.5, 0.0, 0.0, -1.0), high=(1.0, 0.0, 0.0, 1.0)).is_velocity


@pytest.mark.parametrize("change", [{"layers": 0}, {"layers": 9}, {"memory": "none", "hidden_size": 0, "layers": 2}])
def test_layers_are_those_that_a_file_may_have(change: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        metadata(**change)
