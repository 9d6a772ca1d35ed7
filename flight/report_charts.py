"""The pictures of the report: map, time series, LiDAR waterfall, histograms. Each gives SVG text, or "" without data."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flight.run_folder import Run
from flight.scan_log import HIT_CELL_M, NOTHING, STEPS, UNKNOWN, Scans
from flight.svg import Axes, limits, png_image, ramp, svg

WIDE, WIDE_LEFT = 1120.0, 62.0
CHART, CHART_HEIGHT = 560.0, 200.0
SPEED_COLOURS = ("#2c3e94", "#8e2f8f", "#dc4a3d", "#f0a202")
RANGE_COLOURS = ("#7a0f1f", "#d1495b", "#edae49", "#8fc1d4", "#dcebf2")
_SPEED_STEPS = 24
_MAX_PATH_POINTS = 3000
_MAX_MARKS = 400
_MAX_CELLS = 4_000_000
_WATERFALL_COLUMNS = 1200
_TICK_S = 0.05
_SCAN_STANDS_S = 0.2


@dataclass(frozen=True, slots=True)
class Band:
    """Ticks that the safety layer changed, and those in which it braked."""

    limited: NDArray[np.bool_]
    braking: NDArray[np.bool_]


def band_of(run: Run) -> Band:
    """What the safety layer did, per tick."""
    braking = run.ticks["braking"] == 1.0
    return Band(np.array([bool(rules) for rules in run.rules], dtype=bool) & ~braking, braking)


def top_speed(run: Run) -> float:
    """Highest horizontal speed, m/s, at least 0.1: the end of the map's colours."""
    speed = np.hypot(run.ticks["vx_m_s"], run.ticks["vy_m_s"])
    return max(0.1, float(np.nanmax(speed))) if np.isfinite(speed).any() else 0.1


# -- map --------------------------------------------------------------------------------------------------------


def draw_map(run: Run) -> str:
    """The flight from above: obstacles as known and as seen, fence, goal, path by speed, interventions."""
    x, y = run.ticks["x_m"], run.ticks["y_m"]
    hits = run.scans.hit_points_m() if run.scans is not None else np.zeros((0, 2))
    axes = _map_axes(run, hits)
    parts = [axes.frame("x along the corridor, y to the left, m", 12, 5), _boxes(axes, run), _hits(axes, hits), _fence(axes, run)]
    parts += [_goal(axes, run), _truth(axes, run), _touched(axes, run, band_of(run)), _path(axes, run), _ends(axes, x, y)]
    return svg(WIDE, axes.top + axes.height + 42.0, "".join(parts), "Map of the flight from above")


def _map_axes(run: Run, hits: NDArray[np.float64]) -> Axes:
    xs, ys = [run.ticks["x_m"], hits[:, 0]], [run.ticks["y_m"], hits[:, 1]]
    if run.boxes is not None:
        xs.append(run.boxes[:, [0, 3]])
        ys.append(run.boxes[:, [1, 4]])
    for corner in (run.corner("fence_m", "min"), run.corner("fence_m", "max"), run.corner("goal_m")):
        if corner is not None:
            xs.append(np.array(corner[:1]))
            ys.append(np.array(corner[1:2]))
    (x0, x1), (y0, y1) = limits(*xs, least=2.0), limits(*ys, least=2.0)
    width = WIDE - WIDE_LEFT - 12.0
    height = width * (y1 - y0) / (x1 - x0)
    if height > 640.0:  # a place longer across than along: the same scale on both axes, so more x
        spare = 0.5 * ((x1 - x0) * height / 640.0 - (x1 - x0))
        x0, x1, height = x0 - spare, x1 + spare, 640.0
    return Axes((x0, x1), (y0, y1), WIDE_LEFT, 8.0, width, height)


def _rectangle(axes: Axes, low: tuple[float, float], high: tuple[float, float]) -> str:
    (left, right), (top, bottom) = axes.px(np.array([low[0], high[0]])), axes.py(np.array([high[1], low[1]]))
    return f"M{left:.1f} {top:.1f}H{right:.1f}V{bottom:.1f}H{left:.1f}z"


def _boxes(axes: Axes, run: Run) -> str:
    boxes = run.boxes if run.boxes is not None else np.zeros((0, 6))
    return f'<path class="box" d="{"".join(_rectangle(axes, (b[0], b[1]), (b[3], b[4])) for b in boxes)}"/>'


def _hits(axes: Axes, hits: NDArray[np.float64]) -> str:
    """What the LiDAR saw, as one transparent picture: its size does not grow with the flight's length."""
    inside = (hits[:, 0] >= axes.x[0]) & (hits[:, 0] <= axes.x[1]) & (hits[:, 1] >= axes.y[0]) & (hits[:, 1] <= axes.y[1])
    if not inside.any():
        return ""
    cell = HIT_CELL_M
    while (axes.x[1] - axes.x[0]) * (axes.y[1] - axes.y[0]) / cell**2 > _MAX_CELLS:
        cell *= 2.0
    columns, rows = math.ceil((axes.x[1] - axes.x[0]) / cell), math.ceil((axes.y[1] - axes.y[0]) / cell)
    pixels = np.zeros((rows, columns), dtype=np.uint8)
    column = np.floor((hits[inside, 0] - axes.x[0]) / cell).astype(np.intp)
    row = rows - 1 - np.floor((hits[inside, 1] - axes.y[0]) / cell).astype(np.intp)
    pixels[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)] = 1
    unit = axes.width / (axes.x[1] - axes.x[0])
    place = (axes.left, axes.top + axes.height - rows * cell * unit, columns * cell * unit, rows * cell * unit)
    return png_image(pixels, [("#ffffff", 0), ("#3d4653", 255)], place)


def _fence(axes: Axes, run: Run) -> str:
    rings = ["L".join(f"{axes.px(x):.1f} {axes.py(y):.1f}" for x, y in ring) for ring in run.fence_rings()]
    return "".join(f'<path class="fence" d="M{ring}z"/>' for ring in rings)


def _goal(axes: Axes, run: Run) -> str:
    goal, radius_m = run.corner("goal_m"), run.number("goal_radius_m")
    if goal is None:
        return ""
    x, y = float(axes.px(goal[0])), float(axes.py(goal[1]))
    radius = max(4.0, (0.3 if math.isnan(radius_m) else radius_m) * axes.width / (axes.x[1] - axes.x[0]))
    cross = f'<path class="cross" d="M{x - 9:.1f} {y:.1f}h18M{x:.1f} {y - 9:.1f}v18"/>'
    return f'<circle class="goal" cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}"/>{cross}'


def _truth(axes: Axes, run: Run) -> str:
    return axes.line(run.truth[:, 0], run.truth[:, 1], "truth") if run.truth is not None else ""


def _touched(axes: Axes, run: Run, band: Band) -> str:
    """Where the safety layer spoke: a broad band under the path, and a cross for braking."""
    x, y = axes.px(run.ticks["x_m"]), axes.py(run.ticks["y_m"])
    known = np.isfinite(x) & np.isfinite(y)
    broad = "".join(f"M{x[i]:.1f} {y[i]:.1f}h.1" for i in _some(band.limited & known, _MAX_PATH_POINTS))
    crosses = "".join(f"M{x[i] - 4:.1f} {y[i] - 4:.1f}l8 8m-8 0l8-8" for i in _some(band.braking & known, _MAX_MARKS))
    return f'<path class="touched" d="{broad}"/><path class="stop" d="{crosses}"/>'


def _some(where: NDArray[np.bool_], most: int) -> NDArray[np.intp]:
    """Indices of True, evenly thinned to at most `most`."""
    indices = np.flatnonzero(where)
    return indices[:: max(1, math.ceil(indices.size / most))]


def _polyline(x: NDArray[np.float64], y: NDArray[np.float64]) -> str:
    points = " ".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True))
    return f"M{points}" if x.size > 1 else f"M{points}h.1"


def _path(axes: Axes, run: Run) -> str:
    """Stretches of one colour each: neighbouring ticks of about the same speed are one line."""
    speed = np.hypot(run.ticks["vx_m_s"], run.ticks["vy_m_s"])
    known = _some(np.isfinite(run.ticks["x_m"] + run.ticks["y_m"] + speed), _MAX_PATH_POINTS)
    if known.size < 2:
        return ""
    x, y = axes.px(run.ticks["x_m"][known]), axes.py(run.ticks["y_m"][known])
    steps = np.round(speed[known] / top_speed(run) * _SPEED_STEPS).astype(np.int64)
    cuts = [0, *(np.flatnonzero(np.diff(steps)) + 1).tolist(), known.size]
    pieces = ((ramp(steps[a] / _SPEED_STEPS, SPEED_COLOURS), slice(max(0, a - 1), b)) for a, b in pairwise(cuts))
    lines = (f'<path stroke="{colour}" d="{_polyline(x[piece], y[piece])}"/>' for colour, piece in pieces)
    return f'<g class="path">{"".join(lines)}</g>'


def _ends(axes: Axes, x: NDArray[np.float64], y: NDArray[np.float64]) -> str:
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if not known.size:
        return ""
    spots = (("start", known[0]), ("end", known[-1]))
    return "".join(
        f'<circle class="{name}" cx="{float(axes.px(x[i])):.1f}" cy="{float(axes.py(y[i])):.1f}" r="5"/>' for name, i in spots
    )


# -- over time --------------------------------------------------------------------------------------------------


def draw_series(run: Run, curves: dict[str, NDArray[np.float64]], description: str, *, floor: tuple[float, ...] = ()) -> str:
    """Curves over time, class name to values [n]; shaded where the safety layer spoke."""
    time_s = run.ticks["time_s"]
    if time_s.size == 0 or not any(np.isfinite(values).any() for values in curves.values()):
        return ""
    axes = Axes((0.0, max(1.0, float(np.nanmax(time_s)))), limits(*curves.values(), least=0.2, include=floor))
    band = band_of(run)
    shades = axes.bands(time_s, band.limited, _TICK_S, "limited") + axes.bands(time_s, band.braking, _TICK_S, "braking")
    lines = "".join(axes.line(time_s, values, name) for name, values in curves.items())
    return svg(CHART, CHART_HEIGHT, axes.frame("time, s") + shades + lines, description)


def command_curves(run: Run, axis: str) -> dict[str, NDArray[np.float64]]:
    """Wanted, sent and flown velocity along `axis` (x, y, z), m/s."""
    return {
        "wanted": run.ticks[f"wanted_v{axis}_m_s"],
        "sent": run.ticks[f"sent_v{axis}_m_s"],
        "flown": run.ticks[f"v{axis}_m_s"],
    }


def turn_curves(run: Run) -> dict[str, NDArray[np.float64]]:
    """Wanted, sent and flown yaw rate, rad/s; the flown one is the change of yaw over five ticks."""
    time_s, yaw = run.ticks["time_s"], run.ticks["yaw_rad"]
    flown = np.full(yaw.shape, np.nan)
    if yaw.size > 5:
        turned = np.remainder(yaw[5:] - yaw[:-5] + math.pi, 2.0 * math.pi) - math.pi
        flown[3:-2] = turned / np.maximum(time_s[5:] - time_s[:-5], 1e-3)
    return {"wanted": run.ticks["wanted_yaw_rate_rad_s"], "sent": run.ticks["sent_yaw_rate_rad_s"], "flown": flown}


# -- LiDAR ------------------------------------------------------------------------------------------------------


def draw_waterfall(scans: Scans | None) -> str:
    """Range by colour over time (across) and bearing (up is left). A column shows the nearest return of its time."""
    if scans is None or len(scans.poses) == 0:
        return ""
    time_s = scans.poses[:, 0]
    start_s, end_s = float(time_s[0]), max(float(time_s[-1]) + _TICK_S, float(time_s[0]) + 1.0)
    columns = min(_WATERFALL_COLUMNS, math.ceil((end_s - start_s) / _TICK_S))
    place = np.clip(((time_s - start_s) / (end_s - start_s) * columns).astype(np.intp), 0, columns - 1)
    image = np.full((columns, scans.bearings_rad.size), UNKNOWN, dtype=np.uint8)
    np.minimum.at(image, place, scans.codes)
    for here, after in pairwise(np.unique(place)):  # a scan stands until the next one, unless that is long in coming
        if 1 < after - here <= max(1.0, _SCAN_STANDS_S / (end_s - start_s) * columns):
            image[here + 1 : after] = image[here]
    half = 0.5 * abs(float(scans.bearings_rad[-1] - scans.bearings_rad[0])) / max(1, scans.bearings_rad.size - 1)
    bearings_deg = np.degrees([scans.bearings_rad[0] - half, scans.bearings_rad[-1] + half + 1e-9])
    width = WIDE - WIDE_LEFT - 12.0
    axes = Axes((start_s, end_s), (float(bearings_deg[0]), float(bearings_deg[1])), WIDE_LEFT, 8.0, width, 230.0)
    picture = png_image(image.T[::-1], waterfall_palette(), (axes.left, axes.top, axes.width, axes.height))
    middle = f'<path class="ahead" d="M{axes.left:g} {float(axes.py(0.0)):.1f}h{axes.width:g}"/>'
    return svg(WIDE, axes.top + axes.height + 42.0, axes.frame("time, s", 12, 6) + picture + middle, "LiDAR ranges over time")


def waterfall_palette() -> list[tuple[str, int]]:
    """Colour of every beam code."""
    colours = [("#000000", 255), *((ramp(step / (STEPS - 1), RANGE_COLOURS), 255) for step in range(STEPS))]
    colours += [("#ffffff", 255)] * (UNKNOWN - len(colours)) + [("#a7abb3", 255)]
    colours[NOTHING] = ("#ffffff", 255)
    return colours


# -- timing -----------------------------------------------------------------------------------------------------


def draw_histogram(values: NDArray[np.float64], unit: str, description: str) -> str:
    """Counts on a logarithmic scale, so that the one late tick in a thousand is seen."""
    values = values[np.isfinite(values)]
    if not values.size:
        return ""
    low, high = min(0.0, float(values.min())), max(float(values.max()) * 1.02, 1e-3)
    counts, edges = np.histogram(values, bins=48, range=(low, high))
    axes = Axes((low, high), (0.0, math.log10(max(10.0, float(counts.max()))) * 1.05))
    x, y = axes.px(edges), axes.py(np.log10(np.maximum(counts, 1)) + 0.15 * (counts > 0))
    bottom = axes.top + axes.height
    bars = "".join(f"M{a:.1f} {bottom:g}V{max(t, axes.top):.1f}H{b:.1f}V{bottom:g}z" for a, b, t in _bars(x, y, counts))
    p50, p99 = np.percentile(values, (50.0, 99.0))
    marks = "".join(f'<path class="mark" d="M{float(axes.px(p)):.1f} {axes.top:g}V{bottom:g}"/>' for p in (p50, p99))
    return svg(
        CHART, CHART_HEIGHT, axes.frame(unit, 7, 0) + _decades(axes) + f'<path class="bar" d="{bars}"/>' + marks, description
    )


def _bars(x: NDArray[np.float64], y: NDArray[np.float64], counts: NDArray[np.int64]) -> list[tuple[float, float, float]]:
    return [(float(x[k]) + 0.5, float(x[k + 1]) - 0.5, float(y[k])) for k in range(counts.size) if counts[k] > 0]


def _decades(axes: Axes) -> str:
    parts = []
    for power in range(int(axes.y[1]) + 1):
        at = float(axes.py(power + 0.15 if power else 0.15))
        parts.append(f'<path class="grid" d="M{axes.left:g} {at:.1f}h{axes.width:g}"/>')
        parts.append(f'<text x="{axes.left - 6:g}" y="{at + 4:.1f}" text-anchor="end">{10**power}</text>')
    return "".join(parts)
