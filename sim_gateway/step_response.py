"""Response of a vehicle profile to a recorded step, and how far it is from the recorded truth.

PX4 flies on its estimate, so the estimate's recorded error is replayed: what differs then is physics and controller. `free`
leaves that error out and compares with the median of the repetitions, along the step: what a user without estimator noise
gets. Half of what is left there is the estimator's error, which a median over three or four runs does not take out.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from sim_gateway.step_recordings import Array, StepRecording, load_steps
from sim_gateway.vehicle import POS, STEP_S, VEL, height_rate_share, initial_state, roll_pitch_rad, step_velocity, yaw_rad
from sim_gateway.vehicle_params import VehicleParams

GRID_S = 0.02
WINDOW_S = (0.0, 8.0)
BASELINE_S, FINAL_S = (-0.5, 0.0), (4.0, 5.0)
DEAD_SHARE, RISE_SHARE = 0.05, 0.632
RATE_SPAN_S = 0.1
RMS_TARGET, T63_TARGET = 0.15, 0.15
_TO_WORLD = np.array([1.0, -1.0, -1.0])  # NED (x north = ahead) to x ahead, y left, z up


@dataclass(frozen=True, slots=True)
class Response:
    """Motion on the common grid from -1 s on. `velocity` [n, 3] NED m/s, `along` [n]: along the commanded step (m/s or rad/s)."""

    time_s: Array
    velocity: Array
    along: Array
    tilt_rad: Array


@dataclass(frozen=True, slots=True)
class Figures:
    """Shape of a response along the step. Times in s after the step, NaN where the share is never reached."""

    final: float
    dead_time_s: float
    t63_s: float
    peak_tilt_rad: float


@dataclass(frozen=True, slots=True)
class StepFit:
    """One step. `recorded`, `simulated`: medians over the repetitions.

    `rms_m_s`: of the worst axis, median over the repetitions. `*_free`: without the estimate's errors, `rms_free` along the
    step (m/s, or rad/s for a yaw rate). `t63_off`, `t63_free_off`: relative.
    """

    name: str
    repetitions: int
    recorded: Figures
    simulated: Figures
    rms_m_s: float
    t63_off: float
    rms_free: float
    t63_free_off: float

    @property
    def ok(self) -> bool:
        """Whether the step is within both targets."""
        return self.rms_m_s <= RMS_TARGET and abs(self.t63_off) <= T63_TARGET


def simulate(recording: StepRecording, params: VehicleParams, *, replay_error: bool) -> Response:
    """Fly a recording's commands from its first true state."""
    time_s = np.arange(recording.time_s[0], recording.time_s[-1], STEP_S)
    state, row, calm = _start(recording, params), params.as_array(), np.zeros(3)
    error = _at(recording, (recording.estimated_velocity - recording.velocity) * _TO_WORLD, time_s) * float(replay_error)
    height_rate_error = -_at(recording, recording.estimated_descent - recording.velocity[:, 2:], time_s)[:, 0] * float(
        replay_error
    )
    command = recording.command[np.searchsorted(recording.time_s, time_s, side="right") - 1]
    flown = np.empty((time_s.shape[0], 5))
    for k, (vx, vy, vz, yaw_rate) in enumerate(command):
        heading = -yaw_rad(state) if recording.in_body_frame else 0.0
        cos, sin = math.cos(heading), math.sin(heading)
        wanted = np.array((vx * cos - vy * sin, vx * sin + vy * cos, vz)) * _TO_WORLD
        wanted[2] -= height_rate_share(vz) * height_rate_error[k]
        step_velocity(state, row, wanted, -yaw_rate, calm, error[k], 1)
        roll, pitch = roll_pitch_rad(state)
        flown[k, :3] = state[VEL : VEL + 3] * _TO_WORLD
        flown[k, 3], flown[k, 4] = math.acos(math.cos(roll) * math.cos(pitch)), -yaw_rad(state)
    return _response(recording, time_s, flown[:, :3], flown[:, 3], np.unwrap(flown[:, 4]))


def recorded(recording: StepRecording) -> Response:
    """The recorded truth on the common grid."""
    return _response(recording, recording.time_s, recording.velocity, recording.tilt_rad, recording.yaw_rad)


def figures(response: Response) -> Figures:
    """Final value, dead time, t63 and peak tilt of a response; times from the baseline before the step to the final value."""
    t, along = response.time_s, response.along
    base, final = (float(along[(t >= a) & (t <= b)].mean()) for a, b in (BASELINE_S, FINAL_S))
    after = t >= 0.0
    share = (along[after] - base) / (final - base)
    flying = (t >= 0.0) & (t <= FINAL_S[1])
    return Figures(
        final,
        _crossing(t[after], share, DEAD_SHARE),
        _crossing(t[after], share, RISE_SHARE),
        float(response.tilt_rad[flying].max()),
    )


def fit_step(name: str, recordings: list[StepRecording], params: VehicleParams) -> StepFit:
    """Compare all repetitions of one step."""
    real = [recorded(recording) for recording in recordings]
    replayed = [simulate(recording, params, replay_error=True) for recording in recordings]
    free = [simulate(recording, params, replay_error=False) for recording in recordings]
    real_figures, simulated_figures = _median_figures(real), _median_figures(replayed)
    offs = [figures(ours).t63_s / figures(theirs).t63_s - 1.0 for ours, theirs in zip(replayed, real, strict=True)]
    shape_free, shape_real = _median_along(free), _median_along(real)
    return StepFit(
        name=name,
        repetitions=len(recordings),
        recorded=real_figures,
        simulated=simulated_figures,
        rms_m_s=float(np.median([_rms(a.velocity - b.velocity, a.time_s) for a, b in zip(replayed, real, strict=True)])),
        t63_off=float(np.median(offs)),
        rms_free=_rms((shape_free.along - shape_real.along)[:, None], shape_real.time_s),
        t63_free_off=figures(shape_free).t63_s / figures(shape_real).t63_s - 1.0,
    )


def fit_all(paths: list[Path], params: VehicleParams) -> list[StepFit]:
    """Every step found in files and folders. Raises `StepRecordingError`."""
    return [fit_step(name, recordings, params) for name, recordings in load_steps(paths).items()]


def _start(recording: StepRecording, params: VehicleParams) -> Array:
    """Hovering trim at the first recorded place, yaw and velocity."""
    place = recording.position[0] * _TO_WORLD
    state = initial_state(place, -float(recording.yaw_rad[0]), True, params)
    state[POS : POS + 3], state[VEL : VEL + 3] = place, recording.velocity[0] * _TO_WORLD
    return state


def _response(recording: StepRecording, time_s: Array, velocity: Array, tilt_rad: Array, yaw: Array) -> Response:
    grid = np.arange(-1.0, min(WINDOW_S[1], time_s[-1] - RATE_SPAN_S), GRID_S)
    on_grid = np.stack([np.interp(grid, time_s, velocity[:, i]) for i in range(3)], axis=1)
    heading = np.interp(grid, time_s, yaw)
    later, earlier = (np.interp(grid + half, time_s, yaw) for half in (0.5 * RATE_SPAN_S, -0.5 * RATE_SPAN_S))
    along = _along(recording, on_grid, heading, (later - earlier) / RATE_SPAN_S)
    return Response(grid, on_grid, along, np.interp(grid, time_s, tilt_rad))


def _along(recording: StepRecording, velocity: Array, heading: Array, yaw_rate: Array) -> Array:
    """Component along the commanded change; the yaw rate where only that is commanded."""
    before = recording.command[np.searchsorted(recording.time_s, 0.0) - 1]
    during = recording.command[np.searchsorted(recording.time_s, 1.0)]
    change = (during - before)[:3]
    if not change.any():
        return yaw_rate
    if recording.in_body_frame:
        cos, sin = np.cos(heading), np.sin(heading)
        x, y = velocity[:, 0], velocity[:, 1]
        velocity = np.stack((x * cos + y * sin, y * cos - x * sin, velocity[:, 2]), axis=1)
    along: Array = velocity @ (change / np.linalg.norm(change))
    return along


def _at(recording: StepRecording, values: Array, time_s: Array) -> Array:
    return np.stack([np.interp(time_s, recording.time_s, values[:, i]) for i in range(values.shape[1])], axis=1)


def _crossing(time_s: Array, share: Array, level: float) -> float:
    """First time at which a share reaches a level, interpolated; NaN if never."""
    reached = np.flatnonzero(share >= level)
    if reached.shape[0] == 0:
        return math.nan
    k = int(reached[0])
    if k == 0:
        return float(time_s[0])
    part = (level - share[k - 1]) / (share[k] - share[k - 1])
    return float(time_s[k - 1] + part * (time_s[k] - time_s[k - 1]))


def _rms(error: Array, time_s: Array) -> float:
    """Root mean square of the worst axis over the window."""
    inside = (time_s >= WINDOW_S[0]) & (time_s <= WINDOW_S[1])
    return float(np.sqrt((error[inside] ** 2).mean(axis=0)).max())


def _median_along(responses: list[Response]) -> Response:
    """The response whose every sample is the median over the repetitions."""
    n = min(response.time_s.shape[0] for response in responses)
    velocity, along, tilt = (
        np.median([getattr(response, name)[:n] for response in responses], axis=0) for name in ("velocity", "along", "tilt_rad")
    )
    return Response(responses[0].time_s[:n], velocity, along, tilt)


def _median_figures(responses: list[Response]) -> Figures:
    rows = np.array([list(asdict(figures(response)).values()) for response in responses])
    return Figures(*(float(value) for value in np.median(rows, axis=0)))
