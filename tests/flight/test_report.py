"""The report: whole and valid for every kind of flight, self-contained, and drawn by a real browser where there is one."""

from __future__ import annotations

import base64
import json
import math
import re
import shutil
import struct
import subprocess
import zlib
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from flight_records import GOAL, flown, limited, record
from stand import Program

from flight.flight_log import FlightLog
from flight.rate_keeper import LatenessStatistics, RateStatistics
from flight.report import MAX_EVENTS, events_of, write_report
from flight.run_folder import ReportError, read_run
from flight.scan_log import write_scans
from flight.summary import build_summary, write_json_atomic
from flight.svg import encode_png, path_data, ticks
from flight.trajectory import write_timing_csv, write_trajectory_csv
from safety.frames import CorridorVector
from safety.messages import LidarScan, VehicleState

ROOT = Path(__file__).resolve().parents[2]
FENCE = {"min": [0.0, -4.0, 0.3], "max": [20.0, 4.0, 6.0]}
VOID = {"meta", "br", "img", "hr", "input", "link", "col"}
OPTIONAL_END = {"td", "th", "li", "p"}


def corridor_scan(time_s: float, x: float, y: float, yaw: float) -> LidarScan:
    """What a level scanner sees between two walls at y = -4 and 4, with a pillar at (12, 1.5)."""
    bearings = np.linspace(-math.pi / 2, math.pi / 2, 181)
    angle = yaw + bearings
    with np.errstate(divide="ignore"):
        wall = np.where(np.sin(angle) > 0, 4.0 - y, 4.0 + y) / np.abs(np.sin(angle))
    near = np.abs(np.remainder(angle - math.atan2(1.5 - y, 12.0 - x) + math.pi, 2 * math.pi) - math.pi) < 0.1
    ranges = np.where(near, np.hypot(12.0 - x, 1.5 - y) - 0.3, wall)
    ranges[170:] = np.nan
    return LidarScan(time_s, np.where(ranges <= 4.0, ranges, np.where(np.isnan(ranges), np.nan, np.inf)).astype(np.float32),
                     -math.pi / 2, math.pi / 180, 0.1, 4.0)  # fmt: skip


def full_log(ticks_flown: int = 400) -> FlightLog:
    log, zero = FlightLog(), CorridorVector(0.0, 0.0, 0.0)
    for k, (one, sent_s) in enumerate(flown(ticks_flown)):
        log.append(one, sent_s, 0.012 if k == 200 else 0.0002)
        if one.position is not None:
            state = VehicleState(one.now_s, one.position, zero, zero, 0.0, 0.0, one.yaw_rad, 0.0)
            log.see(corridor_scan(one.now_s - 0.03, one.position.x, one.position.y, one.yaw_rad), state)
    return log


def write_run(folder: Path, log: FlightLog, *, outcome: str = "goal_reached", message: str = "goal reached (0.20 m)",
              gateway: bool = True, notes: tuple[str, ...] = ()) -> Path:  # fmt: skip
    """A run folder as a session writes it."""
    folder.mkdir(exist_ok=True)
    extra = {
        "message": message,
        "mission": "corridor",
        "goal_m": [GOAL.x, GOAL.y, GOAL.z],
        "goal_radius_m": 0.3,
        "fence_m": FENCE,
    }
    summary = build_summary(
        log, RateStatistics(20.0, len(log), 1, LatenessStatistics(0.2, 0.2, 12.0)), outcome=outcome, goal=GOAL,
        goal_reached=outcome == "goal_reached", policy_path="a.onnx", policy_sha256="ab" * 32, dynamics="internal",
        failsafe_events=notes, extra=extra,
    )  # fmt: skip
    write_json_atomic(folder / "summary.json", summary)
    write_trajectory_csv(folder / "trajectory.csv", log)
    write_timing_csv(folder / "timing.csv", log)
    write_scans(folder / "scans.npz", log.scans.scans(), log.records[0].now_s if log.records else 0.0)
    if gateway:
        rows = [[r.now_s - 500.0, r.position.x, r.position.y + 0.02, r.position.z, 0, 0, 0, 0] for r in log.records if r.position]
        report = {"boxes": [[0, 4, 0, 20, 4.2, 10], [11.7, 1.2, 0, 12.3, 1.8, 10]], "trajectory": {"rows": rows}}
        (folder / "gateway.json").write_text(json.dumps(report))
    return folder


class Page(HTMLParser):
    """Checks nesting, and keeps what the tests ask about."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        while self.open and self.open[-1] != tag and self.open[-1] in OPTIONAL_END:
            self.open.pop()
        assert self.open, f"</{tag}> without a beginning"
        assert self.open.pop() == tag, f"</{tag}> closes something else"

    def handle_data(self, data: str) -> None:
        self.words += data


def parsed(path: Path) -> Page:
    """The page, checked: well nested, every picture valid XML with finite coordinates, nothing from outside."""
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert page.open == []
    for picture in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        ET.fromstring(picture)
        assert not re.search(r"\bnan\b|\binf\b", re.sub(r'href="[^"]*"', "", picture))
    assert not {tag for tag, _ in page.tags} & {"script", "link", "iframe", "object", "embed", "form"}
    for tag, attributes in page.tags:
        for name in ("href", "src", "srcset", "action", "xlink:href", "data"):
            target = attributes.get(name)
            assert target is None or target.startswith("data:image/png;base64,"), (tag, name)
        assert not any(name.startswith("on") for name in attributes)
    assert "url(" not in text
    assert "@import" not in text
    return page


def drawn(page: Page) -> list[str]:
    return [attributes["aria-label"] or "" for tag, attributes in page.tags if tag == "svg"]


def test_the_report_shows_the_whole_flight(tmp_path: Path) -> None:
    folder = write_run(tmp_path, full_log(), notes=("loop stalled for 0.21 s",))
    path = write_report(folder)
    assert path == folder / "report.html"
    page = parsed(path)
    assert len(drawn(page)) == 1 + 4 + 4 + 1 + 3
    assert {"Map of the flight from above", "LiDAR ranges over time", "Yaw rate over time", "Histogram: Wake-up lateness"} <= set(
        drawn(page)
    )
    for words in ("corridor: goal reached", "goal reached (0.20 m)", "obstacle (40 ticks)", "scan_stale (6 ticks)",
                  "braking (6 ticks)",
                  "1 tick late, up to 12.0 ms", "loop stalled for 0.21 s", "recurrent state starts from zero"):  # fmt: skip
        assert words in page.words, words
    classes = [attributes.get("class") for _, attributes in page.tags]
    assert {"path", "touched", "stop", "box", "fence", "goal", "truth", "limited", "braking", "wanted", "sent", "flown"} <= set(
        classes
    )
    assert ("meta", "width=device-width,initial-scale=1") in [(tag, a.get("content")) for tag, a in page.tags]


def test_what_the_lidar_saw_is_on_the_map_where_nothing_is_known(tmp_path: Path) -> None:
    page = parsed(write_report(write_run(tmp_path, full_log(), gateway=False)))
    images = [attributes["href"] for tag, attributes in page.tags if tag == "image"]
    assert len(images) == 2
    hits, waterfall = (decode_png(base64.b64decode(str(href).split(",")[1])) for href in images)
    assert 500 < np.count_nonzero(hits) < 0.2 * hits.size
    assert waterfall.shape[0] == 181
    assert {254, 255} <= set(np.unique(waterfall))
    assert len(np.unique(waterfall)) > 100


def decode_png(data: bytes) -> np.ndarray:
    """Palette indices of a PNG of ours, by way of its chunks; checks their sums."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, body, size = 8, b"", (0, 0)
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        kind, content = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        assert struct.unpack(">I", data[at + 8 + length : at + 12 + length]) == (zlib.crc32(kind + content),)
        size = struct.unpack(">II", content[:8]) if kind == b"IHDR" else size
        body += content if kind == b"IDAT" else b""
        at += 12 + length
    rows = np.frombuffer(zlib.decompress(body), dtype=np.uint8).reshape(size[1], size[0] + 1)
    assert not rows[:, 0].any()
    return rows[:, 1:]


def test_pictures_are_read_by_an_independent_decoder() -> None:
    from io import BytesIO

    from matplotlib.image import imread

    rng = np.random.default_rng(1)
    pixels = rng.integers(0, 3, (17, 31), dtype=np.uint8)
    palette = [("#102030", 255), ("#ffffff", 0), ("#ff8000", 128)]
    image = imread(BytesIO(encode_png(pixels, palette)), format="png")
    table = np.array([[0x10, 0x20, 0x30, 255], [255, 255, 255, 0], [255, 128, 0, 128]]) / 255.0
    np.testing.assert_allclose(image, table[pixels], atol=1e-6)


@pytest.mark.parametrize("ticks_flown", [0, 1, 2, 7])
def test_a_flight_that_hardly_began_has_a_report(tmp_path: Path, ticks_flown: int) -> None:
    log = full_log(ticks_flown)
    page = parsed(write_report(write_run(tmp_path, log, outcome="safety", message="stopped", gateway=False)))
    assert "safety: stopped" in page.words
    assert "Map of the flight from above" in drawn(page)


def test_a_flight_without_extras_still_has_its_report(tmp_path: Path) -> None:
    """Older folders, and those of a vehicle whose disk was full: only the two files every flight has."""
    folder = write_run(tmp_path, full_log(), gateway=False)
    for name in ("timing.csv", "scans.npz"):
        (folder / name).unlink()
    page = parsed(write_report(folder))
    assert "No scans were kept." in page.words
    assert "LiDAR ranges over time" not in drawn(page)


def test_text_from_outside_stays_text(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script><img src=x onerror=alert(2)>"
    folder = write_run(tmp_path, full_log(20), outcome="<b>x", message=evil, notes=(evil, "&lt;"))
    summary = json.loads((folder / "summary.json").read_text())
    summary["mission"], summary["dynamics"], summary["goal_m"], summary["min_clearance_m"] = evil, evil, ["a", None, {}], "much"
    (folder / "summary.json").write_text(json.dumps(summary))
    page = parsed(write_report(folder))
    assert evil in page.words


@pytest.mark.parametrize("damage", ["torn", "noise", "huge numbers", "wrong shapes"])
def test_damaged_files_are_left_out(tmp_path: Path, damage: str) -> None:
    folder = write_run(tmp_path, full_log(60))
    rng = np.random.default_rng(3)
    for name in ("timing.csv", "scans.npz", "gateway.json", "trajectory.csv"):
        data = (folder / name).read_bytes()
        if damage == "torn":
            data = data[: int(0.7 * len(data))]
        elif damage == "noise":
            data = data if name == "trajectory.csv" else rng.integers(0, 256, len(data), dtype=np.uint8).tobytes()
        elif damage == "huge numbers" and name.endswith("csv"):
            data = data.replace(b"0.05", b"1e400").replace(b"0.1", b"x")
        elif name == "gateway.json":
            data = b'{"boxes": [[1, 2], [3]], "trajectory": {"rows": [[1], [2, 3]]}}'
        (folder / name).write_bytes(data)
    assert "Map of the flight from above" in drawn(parsed(write_report(folder)))


def test_a_folder_without_a_flight_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ReportError, match=r"summary\.json"):
        write_report(tmp_path)
    (tmp_path / "summary.json").write_text('{"outcome": "x"}')
    (tmp_path / "trajectory.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ReportError, match=r"trajectory\.csv"):
        write_report(tmp_path)
    done = Program("flight", "report", str(tmp_path))
    assert done.finish(60.0) == 2
    assert done.err.startswith("fly: ")
    assert done.err.count("\n") == 1


def test_a_table_of_events_stays_readable(tmp_path: Path) -> None:
    log = FlightLog()
    for k in range(4000):
        log.append(record(k, verdict=limited("obstacle") if k % 13 == 0 else limited("fence", clearance_m=1.0)), 0.0)
    folder = write_run(tmp_path, log)
    events = events_of(read_run(folder))
    assert len(events) > MAX_EVENTS
    page = parsed(write_report(folder))
    assert sum(tag == "tr" for tag, _ in page.tags) == 1 + MAX_EVENTS
    assert f"{len(events) - MAX_EVENTS} more are left out" in page.words
    assert "goal_reached: goal reached" in page.words


def test_a_long_flight_makes_a_page_a_phone_can_open(tmp_path: Path) -> None:
    log = FlightLog()
    for k in range(24_000):
        log.append(record(k, verdict=limited("obstacle", braking=k % 7 == 0)), 500.0 + 0.05 * k, 1e-4)
    path = write_report(write_run(tmp_path, log, gateway=False))
    parsed(path)
    assert path.stat().st_size < 1_000_000


def test_thinning_a_curve_keeps_its_peaks() -> None:
    x = np.linspace(0.0, 500.0, 50_000)
    y = np.sin(x)
    y[31_234], y[40_000:40_010] = 77.0, np.nan
    text = path_data(x, y, 0.0, 500.0)
    assert text.count("M") == 2
    assert " 77.0" in text
    assert len(text) < 60_000


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.7, 12.2), (1e-6, 2e-6), (0.0, 72_000.0), (-5.0, -4.9)])
def test_ticks_are_round_and_inside(low: float, high: float) -> None:
    found = ticks(low, high, 6)
    assert 2 <= len(found) <= 8
    assert all(low - 1e-9 <= value <= high + 1e-9 for value in found)


def chromium() -> str | None:
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.mark.parametrize("width", [1240, 500], ids=["desk", "narrow"])
def test_a_browser_draws_it(tmp_path: Path, width: int) -> None:
    """In headless Chromium, with the whole page in one picture. Without a browser the page is at least parsed."""
    path = write_report(write_run(tmp_path / "run", full_log()))
    page = parsed(path)
    browser = chromium()
    if browser is None:
        assert len(drawn(page)) == 13
        return
    picture = tmp_path / "page.png"
    command = [
        browser, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update", "--disable-sync", "--hide-scrollbars", f"--user-data-dir={tmp_path / 'profile'}",
        f"--window-size={width},3000", f"--screenshot={picture}", "--enable-logging=stderr", path.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert picture.exists(), done.stderr[-2000:]
    assert "CONSOLE" not in done.stderr, "the page's own policy or syntax was complained about"
    image = pixels(picture)
    assert image.shape == (3000, width, 3)
    assert (image[-40:, :20] == 255).all(), "light background"
    assert ((image.max(axis=2) < 90).sum()) > 5000, "dark text and lines"
    for colour in ("#1f5fbf", "#c2570c", "#4a6fa5", "#f8c471", "#c0392b"):
        target = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
        near = np.abs(image.astype(int) - target).max(axis=2) < 40
        assert near.sum() > 20, f"{colour} is missing"


def pixels(path: Path) -> np.ndarray:
    from matplotlib.image import imread

    return np.round(imread(path)[:, :, :3] * 255.0).astype(np.uint8)
