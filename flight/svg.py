"""Small drawing kit for the report: axes with round ticks, lines thinned without losing their peaks, and PNG images in SVG."""

from __future__ import annotations

import base64
import math
import struct
import zlib
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
MAX_BINS = 700


@dataclass(frozen=True, slots=True)
class Axes:
    """A plot area in an SVG. Data `x` and `y` limits; `left`, `top`, `width`, `height` in SVG units."""

    x: tuple[float, float]
    y: tuple[float, float]
    left: float = 58.0
    top: float = 8.0
    width: float = 492.0
    height: float = 150.0

    def px(self, x: Floats | float) -> Floats:
        """SVG x of data x."""
        return np.asarray(self.left + (np.asarray(x, dtype=np.float64) - self.x[0]) * (self.width / (self.x[1] - self.x[0])))

    def py(self, y: Floats | float) -> Floats:
        """SVG y of data y (upwards)."""
        return np.asarray(
            self.top + self.height - (np.asarray(y, dtype=np.float64) - self.y[0]) * (self.height / (self.y[1] - self.y[0]))
        )

    def frame(self, x_name: str, x_ticks: int = 7, y_ticks: int = 4) -> str:
        """Grid lines, tick labels and the name of the x axis."""
        right, bottom = self.left + self.width, self.top + self.height
        parts = [f'<rect class="plot" x="{self.left:g}" y="{self.top:g}" width="{self.width:g}" height="{self.height:g}"/>']
        for value in ticks(*self.x, x_ticks):
            at = float(self.px(value))
            parts.append(f'<path class="grid" d="M{at:.1f} {self.top:g}V{bottom:g}"/>')
            parts.append(f'<text x="{at:.1f}" y="{bottom + 16:g}" text-anchor="middle">{label(value)}</text>')
        for value in ticks(*self.y, y_ticks) if y_ticks else ():
            at = float(self.py(value))
            parts.append(f'<path class="grid" d="M{self.left:g} {at:.1f}H{right:g}"/>')
            parts.append(f'<text x="{self.left - 6:g}" y="{at + 4:.1f}" text-anchor="end">{label(value)}</text>')
        parts.append(f'<text x="{right:g}" y="{bottom + 34:g}" text-anchor="end">{escape(x_name)}</text>')
        return "".join(parts)

    def line(self, x: Floats, y: Floats, style: str) -> str:
        """A curve with gaps where `y` is NaN, thinned to what a screen can show."""
        return f'<path class="{style}" d="{path_data(self.px(x), self.py(y), self.left, self.width)}"/>'

    def bands(self, x: Floats, where: NDArray[np.bool_], step: float, style: str) -> str:
        """Shaded stretches of the x axis where `where` holds; `step` is how far one sample reaches."""
        right = self.left + self.width
        spans: list[tuple[float, float]] = []
        for first, last in runs(where):
            start = min(float(self.px(x[first])), right - 1.0)
            stop = max(start + 1.0, min(float(self.px(x[last] + step)), right))
            if spans and start - spans[-1][1] < 0.5:  # nearer than a screen can show: one band, and a small file
                spans[-1] = (spans[-1][0], max(stop, spans[-1][1]))
            else:
                spans.append((start, stop))
        bottom = self.top + self.height
        shape = "".join(f"M{start:.1f} {self.top:g}H{stop:.1f}V{bottom:g}H{start:.1f}z" for start, stop in spans)
        return f'<path class="{style}" d="{shape}"/>' if spans else ""


def svg(width: float, height: float, content: str, description: str) -> str:
    """A picture that fills the width it is given."""
    text = escape(description, quote=True)
    return f'<svg viewBox="0 0 {width:g} {height:.0f}" role="img" aria-label="{text}"><title>{text}</title>{content}</svg>'


def limits(*series: Floats, least: float = 0.1, include: tuple[float, ...] = ()) -> tuple[float, float]:
    """Axis limits around the finite values of all series, a little wider, and at least `least` apart."""
    values = np.concatenate([np.ravel(one) for one in series] + [np.array(include, dtype=np.float64)])
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    spare = max(0.05 * (high - low), 0.5 * (least - (high - low)))
    return low - spare, high + spare


def ticks(low: float, high: float, count: int) -> list[float]:
    """About `count` round values within [low, high]."""
    raw = (high - low) / max(1, count)
    magnitude = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * magnitude for factor in (1.0, 2.0, 5.0, 10.0) if factor * magnitude >= raw * (1.0 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 10) for k in range(first, math.floor(high / step + 1e-9) + 1)]


def label(value: float) -> str:
    """A tick's text, with a real minus sign."""
    return f"{value:g}".replace("-", "\N{MINUS SIGN}")


def runs(where: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """(first, last) index of every stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], where.astype(np.int8), [0]))))
    return [(int(first), int(last) - 1) for first, last in zip(edges[::2], edges[1::2], strict=True)]


def path_data(px: Floats, py: Floats, left: float, width: float) -> str:
    """SVG path of a curve in SVG units; per column of the screen only first, lowest, highest and last point are kept."""
    known = np.isfinite(px) & np.isfinite(py)
    return "".join(_stretch(px[first : last + 1], py[first : last + 1], left, width) for first, last in runs(known))


def _stretch(px: Floats, py: Floats, left: float, width: float) -> str:
    keep = np.arange(px.size)
    if px.size > 4 * MAX_BINS:
        bins = np.floor((px - left) * (MAX_BINS / width)).astype(np.int64)
        starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
        ends = np.append(starts[1:], px.size)
        picked = ((a, a + int(np.argmin(py[a:b])), a + int(np.argmax(py[a:b])), b - 1) for a, b in zip(starts, ends, strict=True))
        keep = np.array(sorted({int(index) for four in picked for index in four}))
    points = " ".join(f"{x:.1f} {y:.1f}" for x, y in zip(px[keep], py[keep], strict=True))
    return f"M{points}" if keep.size > 1 else f"M{points}h.1"


def ramp(fraction: float, anchors: tuple[str, ...]) -> str:
    """Colour between evenly spaced `#rrggbb` anchors."""
    place = min(max(fraction, 0.0), 1.0) * (len(anchors) - 1)
    index = min(int(place), len(anchors) - 2)
    pairs = zip(_rgb(anchors[index]), _rgb(anchors[index + 1]), strict=True)
    return "#" + "".join(f"{round(a + (b - a) * (place - index)):02x}" for a, b in pairs)


def png_image(pixels: NDArray[np.uint8], palette: list[tuple[str, int]], place: tuple[float, float, float, float]) -> str:
    """An SVG image of palette indices [rows, columns]; `palette` (colour, opacity 0..255), `place` x, y, width, height."""
    x, y, width, height = place
    data = base64.b64encode(encode_png(pixels, palette)).decode("ascii")
    return (
        f'<image x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" preserveAspectRatio="none" '
        f'style="image-rendering:pixelated" href="data:image/png;base64,{data}"/>'
    )


def encode_png(pixels: NDArray[np.uint8], palette: list[tuple[str, int]]) -> bytes:
    """A PNG with a palette (ISO/IEC 15948: IHDR, PLTE, tRNS, IDAT, IEND)."""
    rows, columns = pixels.shape
    raw = np.zeros((rows, columns + 1), dtype=np.uint8)  # each row begins with its filter type, 0: none
    raw[:, 1:] = pixels
    colours = bytes(part for colour, _ in palette for part in _rgb(colour))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        (
            _chunk(b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 3, 0, 0, 0)),
            _chunk(b"PLTE", colours),
            _chunk(b"tRNS", bytes(opacity for _, opacity in palette)),
            _chunk(b"IDAT", zlib.compress(raw.tobytes(), 9)),
            _chunk(b"IEND", b""),
        )
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
