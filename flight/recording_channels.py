"""The channels of a recording and of the live view: Foxglove's own schemas where there is one, JSON with a schema elsewhere.

Needs foxglove-sdk (extra `record`); nothing is imported before a flight is recorded. In these channels a number that is not
known is null, and times are Unix time, so that any viewer of MCAP files shows them.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from flight.recording_schema import (
    EVENT_TOPIC,
    HEADER_TOPIC,
    SCAN_TOPIC,
    TICK_TOPIC,
    FlightHeader,
    TickSample,
    encode_event,
    encode_scan,
    encode_tick,
)
from safety.config import Fence
from safety.frames import CorridorVector
from safety.messages import LidarScan, VehicleState

WORLD_FRAME, BODY_FRAME = "corridor", "vehicle"
SCENE_EVERY_TICKS = 200
"""Goal, fence and known obstacles come again every ten seconds, for a viewer that connects in flight.

Not oftener: with a twelfth topic, a chunk's index takes twice the memory (a second node of the writer's map).
"""

Quaternion = tuple[float, float, float, float]

_NUMBER, _FLAG, _TEXT = {"type": "number"}, {"type": "boolean"}, {"type": "string"}
_COMMAND = {"vx_m_s": _NUMBER, "vy_m_s": _NUMBER, "vz_m_s": _NUMBER, "yaw_rate_rad_s": _NUMBER}
_RULES = {"type": "array", "items": {"type": "object", "properties": {"rule": _TEXT, "value": _NUMBER, "limit": _NUMBER}}}
JSON_CHANNELS: dict[str, tuple[str, dict[str, Any]]] = {
    "/command": ("lstm_pilot.Command", {"asked": _FLAG, **_COMMAND}),
    "/safe_command": ("lstm_pilot.SafeCommand", {"sent": _FLAG, "braking": _FLAG, **_COMMAND}),
    "/verdict": (
        "lstm_pilot.Verdict",
        {
            "braking": _FLAG,
            "fault": _TEXT,
            "clearance_m": _NUMBER,
            "fence_margin_m": _NUMBER,
            "scan_age_s": _NUMBER,
            "state_age_s": _NUMBER,
            "interventions": _RULES,
        },
    ),
    "/policy": (
        "lstm_pilot.Policy",
        {"hidden_norm": _NUMBER, "hidden_reset": _FLAG, "inference_us": _NUMBER, "distance_to_goal_m": _NUMBER},
    ),
    "/timing": (
        "lstm_pilot.Timing",
        {
            "tick": _NUMBER,
            "lateness_ms": _NUMBER,
            "scan_to_setpoint_ms": _NUMBER,
            "deadline_misses": _NUMBER,
            "dropped": _NUMBER,
        },
    ),
    HEADER_TOPIC: ("lstm_pilot.Flight", {}),
    SCAN_TOPIC: ("lstm_pilot.ReplayScan", {}),
    TICK_TOPIC: ("lstm_pilot.ReplayTick", {}),
    EVENT_TOPIC: ("lstm_pilot.Event", {"text": _TEXT}),
}


class Channels:
    """All channels of one flight on one Foxglove context. Not for the loop's thread: one tick takes a fraction of a ms."""

    def __init__(self, context: Any, header: FlightHeader) -> None:
        from foxglove import Channel, channels, messages  # noqa: PLC0415  (optional: extra `record`)

        self._header = header
        self._messages = messages
        self._json = {
            topic: Channel(topic, schema={"title": title, "type": "object", "properties": properties}, context=context)
            for topic, (title, properties) in JSON_CHANNELS.items()
        }
        self._scan = channels.LaserScanChannel("/scan", context=context)
        self._pose = channels.PoseInFrameChannel("/pose", context=context)
        self._odometry = channels.OdometryChannel("/odometry", context=context)
        self._transform = channels.FrameTransformChannel("/tf", context=context)
        self._scene = channels.SceneUpdateChannel("/scene", context=context)
        self._log = channels.LogChannel("/log", context=context)
        self._last_scan: LidarScan | None = None
        self._scans = 0

    def start(self, time_s: float) -> None:
        """The header, first of all. Times are on the flight's clock."""
        self._json[HEADER_TOPIC].log(self._header.model_dump_json(), log_time=self._header.unix_ns(time_s))

    def event(self, text: str, time_s: float) -> None:
        """One line of what happened."""
        at = self._header.unix_ns(time_s)
        level = self._messages.LogLevel.Info
        self._json[EVENT_TOPIC].log(encode_event(text), log_time=at)
        self._log.log(self._messages.Log(timestamp=self._stamp(at), level=level, message=text, name="fly"), log_time=at)

    def sample(self, sample: TickSample) -> None:
        """Everything of one tick; a scan only when it is new."""
        at = self._header.unix_ns(sample.record.now_s)
        if sample.scan is not None and sample.scan is not self._last_scan:
            self._last_scan = sample.scan
            self._scans += 1
            self._json[SCAN_TOPIC].log(encode_scan(sample.scan, self._scans), log_time=at)
            self._show_scan(sample.scan, at)
        self._json[TICK_TOPIC].log(encode_tick(sample, None if sample.scan is None else self._scans), log_time=at)
        if sample.state is not None:
            self._show_state(sample.state, at)
        self._show_numbers(sample, at)
        if sample.tick % SCENE_EVERY_TICKS == 0:
            self._show_scene(at)

    def _show_scan(self, scan: LidarScan, at: int) -> None:
        first, step = scan.angle_min_rad, scan.angle_increment_rad
        message = self._messages.LaserScan(
            timestamp=self._stamp(self._header.unix_ns(scan.time_s)),
            frame_id=BODY_FRAME,
            pose=self._pose_of(CorridorVector(0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
            start_angle=first,
            end_angle=first + step * (len(scan.ranges_m) - 1),
            ranges=np.asarray(scan.ranges_m, dtype=np.float64).tolist(),
        )
        self._scan.log(message, log_time=at)

    def _show_state(self, state: VehicleState, at: int) -> None:
        if not all(map(math.isfinite, (state.roll_rad, state.pitch_rad, state.yaw_rad, state.position.x, state.velocity.x))):
            return
        rotation = body_to_corridor(state)
        stamp, pose = self._stamp(self._header.unix_ns(state.time_s)), self._pose_of(state.position, rotation)
        position, messages = state.position, self._messages
        self._pose.log(messages.PoseInFrame(timestamp=stamp, frame_id=WORLD_FRAME, pose=pose), log_time=at)
        velocity = turned_back(state.velocity, rotation)
        self._odometry.log(
            messages.Odometry(
                timestamp=stamp,
                frame_id=WORLD_FRAME,
                body_frame_id=BODY_FRAME,
                pose=pose,
                linear_velocity=self._vector(velocity),
                angular_velocity=messages.Vector3(x=0.0, y=0.0, z=state.yaw_rate_rad_s),
            ),
            log_time=at,
        )
        transform = messages.FrameTransform(
            timestamp=stamp,
            parent_frame_id=WORLD_FRAME,
            child_frame_id=BODY_FRAME,
            translation=self._vector(position),
            rotation=self._quaternion(rotation),
        )
        self._transform.log(transform, log_time=at)

    def _show_numbers(self, sample: TickSample, at: int) -> None:
        record, verdict, wanted = sample.record, sample.record.verdict, sample.record.wanted
        rules = [{"rule": i.rule, "value": _known(i.value), "limit": _known(i.limit)} for i in verdict.interventions]
        documents: dict[str, dict[str, Any]] = {
            "/command": {"asked": wanted is not None, **_command(wanted)},
            "/safe_command": {
                "sent": sample.sent is not None,
                "braking": sample.sent != record.sent or verdict.braking,
                **_command(sample.sent),
            },
            "/verdict": {
                "braking": verdict.braking,
                "fault": verdict.fault or "",
                "clearance_m": _known(verdict.clearance_m),
                "fence_margin_m": _known(verdict.fence_margin_m),
                "scan_age_s": _known(verdict.scan_age_s),
                "state_age_s": _known(verdict.state_age_s),
                "interventions": rules,
            },
            "/policy": {
                "hidden_norm": _known(record.hidden_norm),
                "hidden_reset": record.hidden_reset,
                "inference_us": _known(1e6 * record.inference_s),
                "distance_to_goal_m": _known(record.distance_to_goal_m),
            },
            "/timing": {
                "tick": sample.tick,
                "lateness_ms": _known(1e3 * sample.lateness_s),
                "scan_to_setpoint_ms": _known(1e3 * (sample.sent_time_s - record.scan_time_s)),
                "deadline_misses": sample.deadline_misses,
                "dropped": sample.dropped,
            },
        }
        for topic, document in documents.items():
            self._json[topic].log(json.dumps(document, separators=(",", ":"), allow_nan=False), log_time=at)

    def _show_scene(self, at: int) -> None:
        messages, header = self._messages, self._header
        identity = (1.0, 0.0, 0.0, 0.0)
        diameter = 2.0 * header.goal_radius_m
        goal = messages.SpherePrimitive(
            pose=self._pose_of(header.goal, identity),
            size=messages.Vector3(x=diameter, y=diameter, z=diameter),
            color=messages.Color(r=0.1, g=0.7, b=0.3, a=0.5),
        )
        cubes = [self._cube(box, messages.Color(r=0.5, g=0.55, b=0.6, a=0.7)) for box in header.boxes_m or ()]
        entity = messages.SceneEntity(
            timestamp=self._stamp(at), frame_id=WORLD_FRAME, id="mission", frame_locked=True, cubes=cubes, spheres=[goal],
            lines=self._fence_lines(header.safety.fence),
        )  # fmt: skip
        self._scene.log(messages.SceneUpdate(entities=[entity]), log_time=at)

    def _fence_lines(self, fence: Fence) -> list[Any]:
        """Each polygon of the fence as a closed line, at its floor and at its ceiling."""
        messages, red = self._messages, self._messages.Color(r=0.8, g=0.2, b=0.2, a=0.9)
        pose = self._pose_of(CorridorVector(0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        return [
            messages.LinePrimitive(
                type=messages.LinePrimitiveLineType.LineLoop,
                pose=pose,
                thickness=0.04,
                color=red,
                points=[messages.Point3(x=x, y=y, z=z) for x, y in ring],
            )
            for ring in (fence.polygon, *fence.exclusion)
            for z in (fence.low_m[2], fence.high_m[2])
        ]

    def _cube(self, box: tuple[float, ...], color: Any) -> Any:
        low, high = box[:3], box[3:]
        centre = CorridorVector(*((a + b) / 2.0 for a, b in zip(low, high, strict=True)))
        size = self._messages.Vector3(**{axis: b - a for axis, a, b in zip("xyz", low, high, strict=True)})
        return self._messages.CubePrimitive(pose=self._pose_of(centre, (1.0, 0.0, 0.0, 0.0)), size=size, color=color)

    def _pose_of(self, position: CorridorVector, rotation: Quaternion) -> Any:
        return self._messages.Pose(position=self._vector(position), orientation=self._quaternion(rotation))

    def _vector(self, vector: CorridorVector) -> Any:
        return self._messages.Vector3(x=vector.x, y=vector.y, z=vector.z)

    def _quaternion(self, q: Quaternion) -> Any:
        return self._messages.Quaternion(w=q[0], x=q[1], y=q[2], z=q[3])

    def _stamp(self, unix_ns: int) -> Any:
        return self._messages.Timestamp(sec=unix_ns // 1_000_000_000, nsec=unix_ns % 1_000_000_000)


def body_to_corridor(state: VehicleState) -> Quaternion:
    """(w, x, y, z) from body (x ahead, y left, z up) to corridor: yaw about z, then pitch (nose up is -y), then roll about x."""
    cy, sy = math.cos(state.yaw_rad / 2.0), math.sin(state.yaw_rad / 2.0)
    cp, sp = math.cos(-state.pitch_rad / 2.0), math.sin(-state.pitch_rad / 2.0)
    cr, sr = math.cos(state.roll_rad / 2.0), math.sin(state.roll_rad / 2.0)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def turned_back(vector: CorridorVector, q: Quaternion) -> CorridorVector:
    """A corridor vector in the body frame whose rotation to the corridor is `q`."""
    w, x, y, z = q
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )
    return CorridorVector(*(a * vector.x + b * vector.y + c * vector.z for a, b, c in rows))


def _command(command: Any) -> dict[str, float | None]:
    if command is None:
        return dict.fromkeys(_COMMAND)
    velocity = command.velocity
    values = (velocity.x, velocity.y, velocity.z, command.yaw_rate_rad_s)
    return {name: _known(value) for name, value in zip(_COMMAND, values, strict=True)}


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
