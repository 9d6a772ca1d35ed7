"""`report.html`: one flight on one page that needs nothing else. No script, no network, no font, no other file.

Everything comes from the run folder, so that a report can be made again at any time: `fly report FOLDER`.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flight.report_charts import (
    RANGE_COLOURS,
    SPEED_COLOURS,
    command_curves,
    draw_histogram,
    draw_map,
    draw_series,
    draw_waterfall,
    top_speed,
    turn_curves,
)
from flight.report_page import STYLE, page
from flight.run_folder import Run, read_run
from flight.summary import write_text_atomic
from flight.svg import runs

MAX_EVENTS = 200
LATE_MS = 5.0
_EVENT_GAP_TICKS = 10
_GOOD = {
    "goal_reached": "good",
    "safety": "bad",
    "contact": "bad",
    "internal_error": "bad",
    "loop_stalled": "bad",
    "broken_off": "bad",
}


@dataclass(frozen=True, slots=True)
class Event:
    """One line of the table. `start_s` and `end_s` from the first tick, NaN where nobody noted a time; `kind` a style."""

    start_s: float
    end_s: float
    kind: str
    text: str


def write_report(folder: Path) -> Path:
    """Write `report.html` into a run folder and give its path. Raises `ReportError` where the folder holds no flight."""
    run = read_run(folder)
    path = folder / "report.html"
    write_text_atomic(path, _document(run))
    return path


def events_of(run: Run) -> list[Event]:
    """What happened, in order: interventions, braking, faults, recurrent resets, late ticks, and the flight's own notes."""
    time_s = run.ticks["time_s"]
    found = [event for rule in sorted({rule for rules in run.rules for rule in rules}) for event in _rule_events(run, rule)]
    braking = run.ticks["braking"] == 1.0
    found += [Event(time_s[a], time_s[b], "bad", f"braking ({_ticks(braking[a : b + 1])})") for a, b in _stretches(braking)]
    resets = np.flatnonzero(run.ticks["hidden_reset"] == 1.0)
    found += [Event(time_s[i], time_s[i], "plain", "recurrent state starts from zero") for i in resets]
    found += _late_events(run)
    found.sort(key=lambda event: event.start_s)
    notes = run.summary.get("failsafe_events")
    found += [Event(math.nan, math.nan, "bad", str(note)) for note in notes] if isinstance(notes, list) else []
    end_s = float(time_s[-1]) if time_s.size else math.nan
    outcome = str(run.summary.get("outcome", "unknown"))
    found.append(Event(end_s, end_s, _GOOD.get(outcome, "plain"), f"{outcome}: {run.summary.get('message', '')}".rstrip(": ")))
    return found


def _rule_events(run: Run, rule: str) -> list[Event]:
    where = np.array([rule in rules for rules in run.rules], dtype=bool)
    time_s = run.ticks["time_s"]
    return [Event(time_s[a], time_s[b], "limited", f"{rule} ({_ticks(where[a : b + 1])})") for a, b in _stretches(where)]


def _late_events(run: Run) -> list[Event]:
    if run.timing is None:
        return []
    late, time_s = run.timing["lateness_ms"], run.timing["time_s"]
    found = []
    for a, b in _stretches(late > LATE_MS):
        stretch = late[a : b + 1]
        text = f"{_ticks(stretch > LATE_MS)} late, up to {float(np.nanmax(stretch)):.1f} ms"
        found.append(Event(time_s[a], time_s[b], "plain", text))
    return found


def _ticks(where: NDArray[np.bool_]) -> str:
    count = int(where.sum())
    return "1 tick" if count == 1 else f"{count} ticks"


def _stretches(where: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Runs of True; those less than half a second apart are one."""
    joined: list[tuple[int, int]] = []
    for first, last in runs(where):
        if joined and first - joined[-1][1] <= _EVENT_GAP_TICKS:
            joined[-1] = (joined[-1][0], last)
        else:
            joined.append((first, last))
    return joined


# -- page -------------------------------------------------------------------------------------------------------


def _document(run: Run) -> str:
    outcome = str(run.summary.get("outcome", "unknown"))
    title = f"{run.summary.get('mission', 'flight')}: {outcome.replace('_', ' ')}"
    message = escape(str(run.summary.get("message", "")))
    head = f'<header><h1>{escape(title)}</h1><p class="{_GOOD.get(outcome, "plain")}">{message}</p></header>'
    parts = [head, _figures(run), _map_section(run), _series_section(run), _lidar_section(run)]
    parts += [_timing_section(run), _events_section(events_of(run)), _everything(run)]
    return page(title, STYLE, "".join(parts))


def _figures(run: Run) -> str:
    """The summary at a glance."""
    ticks = run.number("loop", "ticks")
    figures = [
        ("duration", _text(run.number("duration_s"), "s", 1)),
        ("path flown", _text(run.number("path_length_m"), "m", 2)),
        ("path efficiency", _text(100.0 * run.number("path_efficiency"), "%", 1)),
        ("smallest clearance", _text(run.number("min_clearance_m"), "m", 2)),
        ("collisions", _text(run.number("collisions"), "", 0)),
        ("fence breaches", _text(run.number("geofence_breaches"), "", 0)),
        ("top speed", _text(top_speed(run), "m/s", 2)),
        ("ticks the safety layer changed", f"{sum(map(bool, run.rules))} of {_text(ticks, '', 0)}"),
        ("loop rate", _text(run.number("loop", "rate_hz"), "Hz", 3)),
        ("late or missed ticks", _text(run.number("loop", "deadline_misses"), "", 0)),
        ("lateness p50 / p99", _pair(run, "ms", 2, "loop", "lateness_ms")),
        ("scan to setpoint p50 / p99", _pair(run, "ms", 1, "loop", "scan_to_setpoint_ms")),
        ("inference p50 / p99", _pair(run, "\N{MICRO SIGN}s", 0, "inference_us")),
        ("flown in", str(run.summary.get("dynamics", "\N{EN DASH}"))),
    ]
    cells = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in figures)
    return f'<dl class="figures">{cells}</dl>'


def _text(value: float, unit: str, digits: int) -> str:
    return f"{value:.{digits}f} {unit}".rstrip() if math.isfinite(value) else "\N{EN DASH}"


def _short(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _pair(run: Run, unit: str, digits: int, *keys: str) -> str:
    p50, p99 = (_text(run.number(*keys, name), "", digits) for name in ("p50", "p99"))
    return f"{p50} / {p99} {unit}"


def _map_section(run: Run) -> str:
    known = "Outlined: obstacles the simulator knows. " if run.boxes is not None else ""
    seen = "Dark: what the LiDAR saw." if run.scans is not None else "No scans were kept."
    keys = [("path", "vehicle, coloured by speed"), ("touched", "command limited"), ("stop", "braking"), ("goal", "goal")]
    keys += [("fence", "fence")] if run.corner("fence_m", "min") else []
    keys += [("truth", "true path")] if run.truth is not None else []
    scale = _scale(SPEED_COLOURS, "0", f"{top_speed(run):.2f} m/s")
    note = f"<p>Ring: start, dot: end. {known}{seen} Scroll sideways on a small screen.</p>"
    return _section("Map", _wide(draw_map(run)) + _keys(keys) + scale + note)


def _series_section(run: Run) -> str:
    names = {"x": "along the corridor", "y": "to the left", "z": "up"}
    charts = [
        (f"Velocity {words} (v{axis}), m/s", draw_series(run, command_curves(run, axis), f"Velocity {words} over time"))
        for axis, words in names.items()
    ]
    charts.append(("Yaw rate, rad/s", draw_series(run, turn_curves(run), "Yaw rate over time")))
    keys = [("wanted", "policy wants"), ("sent", "safe command sent"), ("flown", "vehicle did")]
    keys += [("limited", "limited"), ("braking", "braking")]
    margins = {"clear": run.ticks["clearance_m"], "margin": run.ticks["fence_margin_m"]}
    others = [
        ("Clearance and fence margin, m", draw_series(run, margins, "Clearance and fence margin over time", floor=(0.0,))),
        ("Distance to goal, m", draw_series(run, {"flown": run.ticks["distance_to_goal_m"]}, "Distance to goal", floor=(0.0,))),
        ("Height, m", draw_series(run, {"flown": run.ticks["z_m"]}, "Height over time")),
        ("Age of the scan used, s", draw_series(run, {"flown": run.ticks["scan_age_s"]}, "Age of the scan", floor=(0.0,))),
    ]
    first = _section("Command, safe command and response", _keys(keys) + _grid(charts))
    return first + _section("Margins", _keys([("clear", "clearance"), ("margin", "fence margin")]) + _grid(others))


def _lidar_section(run: Run) -> str:
    picture = draw_waterfall(run.scans)
    if not picture or run.scans is None:
        return _section("LiDAR", "<p>No scans were kept.</p>")
    scale = _scale(RANGE_COLOURS, "0 m", f"{run.scans.range_max_m:g} m")
    swatches = '<span><i style="background:#fff;border:1px solid #999"></i>nothing within range</span>'
    swatches += '<span><i style="background:#a7abb3"></i>unknown</span><span><i style="background:#000"></i>too near</span>'
    note = "<p>Up is left of the vehicle, the line is straight ahead; degrees.</p>"
    return _section("LiDAR", _wide(picture) + scale + f'<p class="keys">{swatches}</p>' + note)


def _timing_section(run: Run) -> str:
    if run.timing is None:
        return _section("Timing", "<p>The folder holds no timing.csv; the figures above are from summary.json.</p>")
    charts = []
    for column, name, unit in (
        ("lateness_ms", "Wake-up lateness", "ms"),
        ("scan_to_setpoint_ms", "From scan to setpoint", "ms"),
        ("inference_us", "Inference", "\N{MICRO SIGN}s"),
    ):
        values = run.timing[column][np.isfinite(run.timing[column])]
        if values.size:
            p50, p99, worst = np.percentile(values, (50.0, 99.0, 100.0))
            heading = f"{name}: p50 {_short(p50)}, p99 {_short(p99)}, max {_short(worst)} {unit}"
            charts.append((heading, draw_histogram(values, unit, f"Histogram: {name}")))
    note = "<p>Number of ticks, logarithmic. Lines: p50 and p99.</p>"
    return _section("Timing", note + _grid(charts)) if charts else _section("Timing", "<p>No tick was timed.</p>")


def _events_section(events: list[Event]) -> str:
    rows = "".join(
        f'<tr class="{event.kind}"><td>{_text(event.start_s, "", 2)}<td>{_span(event)}<td>{escape(event.text)}</tr>'
        for event in (events if len(events) <= MAX_EVENTS else [*events[: MAX_EVENTS - 1], events[-1]])
    )
    more = f"<p>{len(events) - MAX_EVENTS} more are left out.</p>" if len(events) > MAX_EVENTS else ""
    head = "<thead><tr><th>at, s</th><th>for, s</th><th>event</th></tr></thead>"
    return _section("Events", f'<div class="scroll"><table>{head}<tbody>{rows}</tbody></table></div>{more}')


def _span(event: Event) -> str:
    span_s = event.end_s - event.start_s
    return f"{span_s:.2f}" if math.isfinite(span_s) and span_s > 0.0 else ""


def _everything(run: Run) -> str:
    text = escape(json.dumps(run.summary, indent=1, ensure_ascii=False))
    return f"<section><details><summary>summary.json</summary><pre>{text}</pre></details></section>"


def _section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{content}</section>"


def _wide(picture: str) -> str:
    return f'<div class="wide" tabindex="0">{picture}</div>'


def _grid(charts: list[tuple[str, str]]) -> str:
    figures = "".join(f"<figure><figcaption>{escape(name)}</figcaption>{picture}</figure>" for name, picture in charts if picture)
    return f'<div class="grid2">{figures}</div>' if figures else "<p>Nothing was recorded.</p>"


def _keys(keys: list[tuple[str, str]]) -> str:
    return '<p class="keys">' + "".join(f'<span><i class="k-{name}"></i>{escape(text)}</span>' for name, text in keys) + "</p>"


def _scale(colours: tuple[str, ...], low: str, high: str) -> str:
    gradient = ",".join(colours)
    return f'<p class="scale">{escape(low)} <i style="background:linear-gradient(90deg,{gradient})"></i> {escape(high)}</p>'
