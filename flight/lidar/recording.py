"""Recorded scans: the interface every recording implements, a plain .npz file of scans, and the session that plays one.

An .npz file holds, for n scans of b beams: `time_s` [n] (any clock, increasing), `ranges_m` float32 [n, b] with the meaning of
`LidarScan`, and `angle_min_rad`, `angle_increment_rad`, `range_min_m`, `range_max_m` (one number each).
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flight.lidar.config import LidarSource
from flight.lidar.session import Host, NoMoreScansError
from safety.lidar import MAX_BEAMS, scan_problem
from safety.messages import LidarScan

MAX_SCANS = 200_000
_MAX_ARRAY_BYTES = 2**30
_SCALARS = ("angle_min_rad", "angle_increment_rad", "range_min_m", "range_max_m")
_ARRAYS = ("time_s", "ranges_m")


class ScanFileError(ValueError):
    """A recording that cannot be used; the message says what is wrong with it."""


class ScanSource(Protocol):
    """Anything that holds recorded scans: a file of this module, a flight recording, a list in a test."""

    def scans(self) -> Iterable[LidarScan]:
        """The scans in order of time, from the beginning at every call. `time_s` on the recording's own clock."""
        ...


ScanReader = Callable[[Path], ScanSource]
READERS: dict[str, ScanReader] = {}
"""File suffix to reader. A module that reads another format adds itself with `register_reader`."""


def register_reader(suffix: str, reader: ScanReader) -> None:
    """Let `driver: recording` play files with this suffix (`.mcap`)."""
    READERS[suffix] = reader


def open_recording(path: Path) -> ScanSource:
    """The recording in a file, by its suffix. Raises `ScanFileError`."""
    reader = READERS.get(path.suffix)
    if reader is None:
        raise ScanFileError(f"{path}: no reader for {path.suffix or 'a file without suffix'}: have {', '.join(sorted(READERS))}")
    return reader(path)


class NpzScans:
    """A file written by `write_npz`. Raises `ScanFileError` if it is not one, or larger than is reasonable."""

    def __init__(self, path: Path) -> None:
        try:
            with np.load(path, allow_pickle=False) as archive:
                _check_sizes(archive)
                arrays = {name: np.asarray(archive[name]) for name in (*_ARRAYS, *_SCALARS)}
        except KeyError as error:
            raise ScanFileError(f"{path}: array {error} is missing: not a recording of scans") from None
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ScanFileError(f"{path}: cannot be read: {error}") from None
        self._time_s, self._ranges_m, self._geometry = _checked(path, arrays)

    def scans(self) -> Iterator[LidarScan]:
        """See `ScanSource`."""
        for number, (time_s, ranges) in enumerate(zip(self._time_s, self._ranges_m, strict=True)):
            yield LidarScan(float(time_s), ranges.copy(), *self._geometry, sequence=number)


def _check_sizes(archive: np.lib.npyio.NpzFile) -> None:
    """Before anything is unpacked: a small file can unpack to a large one."""
    if archive.zip is not None and sum(item.file_size for item in archive.zip.infolist()) > _MAX_ARRAY_BYTES:
        raise ValueError(f"more than {_MAX_ARRAY_BYTES >> 20} MiB of scans")


def _checked(
    path: Path, arrays: dict[str, NDArray[np.generic]]
) -> tuple[NDArray[np.float64], NDArray[np.float32], tuple[float, float, float, float]]:
    time_s, ranges = arrays["time_s"], arrays["ranges_m"]
    if any(arrays[name].dtype.kind not in "fiu" for name in (*_ARRAYS, *_SCALARS)):
        raise ScanFileError(f"{path}: every array must hold numbers")
    if ranges.ndim != 2 or time_s.shape != ranges.shape[:1] or not 1 <= len(time_s) <= MAX_SCANS:
        raise ScanFileError(f"{path}: time_s {time_s.shape} and ranges_m {ranges.shape} do not fit: want [n] and [n, beams]")
    if not 2 <= ranges.shape[1] <= MAX_BEAMS or any(arrays[name].size != 1 for name in _SCALARS):
        raise ScanFileError(f"{path}: want 2..{MAX_BEAMS} beams and one number for each of {', '.join(_SCALARS)}")
    times = time_s.astype(np.float64)
    if not np.isfinite(times).all() or not (np.diff(times) > 0.0).all():
        raise ScanFileError(f"{path}: time_s must be finite and increase")
    low, step, near, far = (float(arrays[name].reshape(-1)[0]) for name in _SCALARS)
    geometry = (low, step, near, far)
    problem = scan_problem(LidarScan(0.0, ranges[0].astype(np.float32), *geometry))
    if problem is not None:
        raise ScanFileError(f"{path}: the geometry {dict(zip(_SCALARS, geometry, strict=True))} is impossible ({problem})")
    return times, ranges.astype(np.float32), geometry


def write_npz(path: Path, scans: Iterable[LidarScan]) -> int:
    """Write scans of one geometry; how many. Raises `ScanFileError` when there are none or their geometry changes."""
    taken = list(scans)
    geometries = {(scan.ranges_m.size, *(getattr(scan, name) for name in _SCALARS)) for scan in taken}
    if len(geometries) != 1:
        raise ScanFileError(f"a file of scans holds one geometry, these have {len(geometries)}")
    first, times = taken[0], np.array([scan.time_s for scan in taken])
    np.savez_compressed(
        path,
        time_s=times,
        ranges_m=np.stack([scan.ranges_m for scan in taken]).astype(np.float32),
        angle_min_rad=np.float64(first.angle_min_rad),
        angle_increment_rad=np.float64(first.angle_increment_rad),
        range_min_m=np.float64(first.range_min_m),
        range_max_m=np.float64(first.range_max_m),
    )
    return len(taken)


class RecordingSession:
    """Plays a recording in real time, dated as if it were measured now. See `session.Session`."""

    clock_uncertainty_s = 0.0
    clock_drift_s = 0.0

    def __init__(self, source: ScanSource, host: Host) -> None:
        self._source = source
        self._host = host

    def open(self) -> str:
        """What is played."""
        return f"recording {self._host.config.path or ''}".rstrip()

    def quit(self) -> None:
        """Nothing to stop."""

    def close(self) -> None:
        """Nothing to close."""

    def scans(self) -> Iterator[LidarScan]:
        """The scans at the pace of the recording; raises `NoMoreScansError` after the last, unless it repeats."""
        while not self._host.stop.is_set():
            played = 0
            for scan in self._once():
                played += 1
                yield scan
            if not self._host.config.repeat or played == 0:
                if not self._host.stop.is_set():
                    raise NoMoreScansError("the recording is over")
                return

    def _once(self) -> Iterator[LidarScan]:
        start_s, first_s = self._host.now(), math.nan
        for scan in self._source.scans():
            first_s = scan.time_s if math.isnan(first_s) else first_s
            due_s = start_s + (scan.time_s - first_s) / self._host.config.speed
            while not self._host.stop.is_set() and self._host.now() < due_s:
                self._host.stop.wait(max(0.0, due_s - self._host.now()))
            if self._host.stop.is_set():
                return
            yield LidarScan(
                due_s, scan.ranges_m, scan.angle_min_rad, scan.angle_increment_rad, scan.range_min_m, scan.range_max_m
            )
        self._host.stop.wait(0.05)  # before it repeats: the last scan had its time too


def recording_session(config: LidarSource, host: Host, source: ScanSource | None = None) -> RecordingSession:
    """The session for `driver: recording`. Raises `ScanFileError`."""
    if source is None:
        if config.path is None:
            raise ScanFileError("driver recording needs lidar.path")
        source = open_recording(config.path)
    return RecordingSession(source, host)


register_reader(".npz", NpzScans)
