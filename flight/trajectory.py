"""The flight as flown: a CSV that is the same for the same flight, one of its timing, and the picture from above."""

from __future__ import annotations

import csv
import logging
import math
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flight.flight_log import FlightLog as FlightLog  # noqa: PLC0414  (named here since the first flights)
from flight.scan_log import MAX_HIT_CELLS as MAX_HIT_CELLS  # noqa: PLC0414
from flight.tick import TickRecord
from safety.config import Fence
from safety.frames import CorridorVector

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_log = logging.getLogger(__name__)

TIMING_COLUMNS = ("time_s", "lateness_ms", "scan_to_setpoint_ms", "inference_us")
CSV_COLUMNS = (
    "time_s",
    "x_m",
    "y_m",
    "z_m",
    "vx_m_s",
    "vy_m_s",
    "vz_m_s",
    "yaw_rad",
    "wanted_vx_m_s",
    "wanted_vy_m_s",
    "wanted_vz_m_s",
    "wanted_yaw_rate_rad_s",
    "sent_vx_m_s",
    "sent_vy_m_s",
    "sent_vz_m_s",
    "sent_yaw_rate_rad_s",
    "braking",
    "rules",
    "clearance_m",
    "fence_margin_m",
    "distance_to_goal_m",
    "scan_age_s",
    "state_age_s",
    "hidden_reset",
)


def write_trajectory_csv(path: Path, log: FlightLog) -> None:
    """One row a tick, `CSV_COLUMNS`, six decimals, NaN as an empty cell, times from the first tick.

    Wall-clock measurements are left out: in lockstep the same seed gives the same bytes.
    """
    with path.open("w", encoding="ascii", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CSV_COLUMNS)
        start_s = log.records[0].now_s if log.records else 0.0
        for record in log.records:
            writer.writerow(_row(record, start_s))


def write_timing_csv(path: Path, log: FlightLog) -> None:
    """One row a tick, `TIMING_COLUMNS`: what this computer's clock said, and so never the same twice."""
    with path.open("w", encoding="ascii", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(TIMING_COLUMNS)
        start_s = log.records[0].now_s if log.records else 0.0
        for (record, sent_s), lateness_s in zip(log, log.lateness_s.tolist(), strict=True):
            times = (1e3 * lateness_s, 1e3 * (sent_s - record.scan_time_s), 1e6 * record.inference_s)
            writer.writerow([_cell(record.now_s - start_s), *map(_cell, times)])


def _row(record: TickRecord, start_s: float) -> list[str]:
    wanted, sent, verdict = record.wanted, record.sent, record.verdict
    return [
        _cell(record.now_s - start_s),
        *_vector(record.position),
        *_vector(record.velocity),
        _cell(record.yaw_rad),
        *_vector(wanted.velocity if wanted is not None else None),
        _cell(wanted.yaw_rate_rad_s if wanted is not None else math.nan),
        *_vector(sent.velocity),
        _cell(sent.yaw_rate_rad_s),
        str(int(verdict.braking)),
        " ".join(intervention.rule for intervention in verdict.interventions),
        _cell(verdict.clearance_m),
        _cell(verdict.fence_margin_m),
        _cell(record.distance_to_goal_m),
        _cell(verdict.scan_age_s),
        _cell(verdict.state_age_s),
        str(int(record.hidden_reset)),
    ]


def _vector(vector: CorridorVector | None) -> tuple[str, str, str]:
    if vector is None:
        return ("", "", "")
    return (_cell(vector.x), _cell(vector.y), _cell(vector.z))


def _cell(value: float) -> str:
    if math.isnan(value):
        return ""
    text = f"{value:.6f}"
    return "0.000000" if text == "-0.000000" else text


def draw_trajectory_png(
    path: Path,
    log: FlightLog,
    *,
    boxes: NDArray[np.float64] | None,
    goal: CorridorVector,
    goal_radius_m: float,
    fence: Fence | None,
    truth: NDArray[np.float64] | None = None,
    title: str = "",
) -> bool:
    """Draw the flight from above. False, with a hint in the log, where matplotlib is not installed.

    `boxes`: [n, 6] obstacles (xmin, ymin, zmin, xmax, ymax, zmax), m, corridor frame; None draws what the LiDAR saw
    (`FlightLog.see`). `truth`: [k, 2 or 3] true positions where a simulator knows them.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  (optional: extra `report`)
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError:
        _log.warning("no %s: matplotlib is missing; pip install 'lstm-pilot[report]'", path.name)
        return False
    figure = Figure(layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    _draw_surroundings(axes, boxes, log.hit_points_m, fence)
    _draw_goal(axes, goal, goal_radius_m)
    _draw_path(figure, axes, log, truth)
    _finish(figure, axes, title)
    figure.savefig(path, dpi=130)
    return True


def _draw_surroundings(axes: Axes, boxes: NDArray[np.float64] | None, hits_m: NDArray[np.float64], fence: Fence | None) -> None:
    from matplotlib.patches import Polygon, Rectangle  # noqa: PLC0415

    if boxes is None:
        axes.plot(hits_m[:, 0], hits_m[:, 1], "s", color="#5b6470", markersize=1.5, label="seen by LiDAR", zorder=2)
    for x0, y0, _, x1, y1, _ in boxes if boxes is not None else ():
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, facecolor="#8d96a3", edgecolor="#4a525e", linewidth=0.8, zorder=2))
    if boxes is not None and len(boxes):
        axes.update_datalim(
            [(float(boxes[:, 0].min()), float(boxes[:, 1].min())), (float(boxes[:, 3].max()), float(boxes[:, 4].max()))]
        )
    if fence is not None:
        for k, ring in enumerate((fence.polygon, *fence.exclusion)):
            fill, label = ("#c0392b22", "") if k else ("none", "fence")
            axes.add_patch(Polygon(ring, facecolor=fill, edgecolor="#c0392b", linestyle=(0, (6, 4)), zorder=3, label=label))
            axes.update_datalim(ring)


def _draw_goal(axes: Axes, goal: CorridorVector, radius_m: float) -> None:
    from matplotlib.patches import Circle  # noqa: PLC0415

    axes.add_patch(Circle((goal.x, goal.y), radius_m, facecolor="#27ae6055", edgecolor="#1e8449", linewidth=1.5, zorder=4))
    axes.plot(
        [goal.x], [goal.y], "*", color="#1e8449", markersize=11, zorder=5, label=f"goal (radius {radius_m:g} m)", linestyle="none"
    )


def _draw_path(figure: Figure, axes: Axes, log: FlightLog, truth: NDArray[np.float64] | None) -> None:
    from matplotlib.collections import LineCollection  # noqa: PLC0415

    if truth is not None and len(truth):
        axes.plot(truth[:, 0], truth[:, 1], color="black", linewidth=1.0, zorder=5, label="true path")
    flown = [r for r in log.records if r.position is not None and r.velocity is not None]
    points = log.positions_m[:, :2]
    if len(points) < 2:
        return
    speeds = [math.hypot(r.velocity.x, r.velocity.y) for r in flown[1:] if r.velocity is not None]
    path = LineCollection(list(pairwise(map(tuple, points))), cmap="viridis", linewidth=2.6, zorder=6, capstyle="round")
    path.set_array(np.array(speeds))
    path.set_clim(0.0, max(0.1, float(np.max(speeds))))
    axes.add_collection(path)
    axes.update_datalim(points)
    figure.colorbar(path, ax=axes, label="speed, m/s", shrink=0.85, pad=0.01, aspect=18)
    axes.plot(
        *points[0], "o", markerfacecolor="white", markeredgecolor="black", markersize=8, zorder=8, label="start", linestyle="none"
    )
    _mark(
        axes,
        flown,
        braking=False,
        style={"marker": "o", "color": "#f8c471", "markersize": 8.0, "zorder": 4},
        label="command limited",
    )
    _mark(axes, flown, braking=True, style={"marker": "X", "color": "#e74c3c", "markersize": 7.0, "zorder": 7}, label="braking")


def _mark(axes: Axes, flown: list[TickRecord], *, braking: bool, style: dict[str, Any], label: str) -> None:
    marked = [r.position for r in flown if r.verdict.braking is braking and (braking or r.verdict.interventions)]
    if not marked:
        return
    xs, ys = [p.x for p in marked if p is not None], [p.y for p in marked if p is not None]
    axes.plot(xs, ys, linestyle="none", markeredgewidth=0.0, label=f"{label} ({len(marked)} ticks)", **style)


def _finish(figure: Figure, axes: Axes, title: str) -> None:
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.margins(0.02)
    axes.set(xlabel="x along the corridor, m", ylabel="y left, m")
    axes.grid(color="#e3e6ea", linewidth=0.6, zorder=0)
    axes.set_axisbelow(True)
    if title:
        axes.set_title(title, fontsize=11, loc="left")
    width_m, height_m = (max(1.0, abs(b - a)) for a, b in (axes.get_xlim(), axes.get_ylim()))
    scale = min(14.0 / width_m, 9.0 / height_m)
    figure.set_size_inches(max(6.0, width_m * scale + 1.2), max(3.2, height_m * scale + 1.25))
    figure.legend(loc="outside lower center", ncols=6, fontsize=8, frameon=False)
