"""Points of a spinning LiDAR as its decoder gives them: device frame, firing order, no clock but the device's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

NO_STAMP = -1


@dataclass(frozen=True, slots=True)
class Points:
    """Arrays of equal length [n], in the order in which the beams fired.

    `bearing_rad`: 0 at the device's front, positive left. `range_m`: nan where the device measured nothing (it does not say
    why). `intensity`: 0..255. `before_end_s`: how long before the end of its frame the beam fired. `stamp_ms`: the device's
    clock at the end of the frame, or `NO_STAMP`. `bytes_behind`: bytes that had arrived after the frame when it was decoded.
    """

    bearing_rad: NDArray[np.float64]
    range_m: NDArray[np.float32]
    intensity: NDArray[np.uint8]
    before_end_s: NDArray[np.float64]
    stamp_ms: NDArray[np.int64]
    bytes_behind: NDArray[np.int64]

    def __len__(self) -> int:
        return int(self.bearing_rad.size)


def join_points(parts: Sequence[Points]) -> Points:
    """All of them in order; no parts give no points."""
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return no_points()
    return Points(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Points)))


def no_points() -> Points:
    """Nothing decoded."""
    whole = np.empty(0, dtype=np.int64)
    real = np.empty(0, dtype=np.float64)
    return Points(real, np.empty(0, dtype=np.float32), np.empty(0, dtype=np.uint8), real, whole, whole)


class PointDecoder(Protocol):
    """Bytes in, points out. Takes any bytes in any chunks, never raises, never keeps more than a frame or two."""

    bad_checksums: int
    bad_frames: int

    @property
    def buffered_bytes(self) -> int:
        """Bytes kept for the next call."""
        ...

    def feed(self, data: bytes) -> Points:
        """The points that these bytes complete."""
        ...
