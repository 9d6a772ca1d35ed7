"""Where compiled kernels are kept: one folder per state of the sources, so that a stale kernel can never be used.

numba's own cache looks only at the file a kernel stands in, not at the files of the kernels and constants compiled into it:
after a change of `vehicle_params.py`, a cached `vehicle.py` would silently fly the old physics. So the cache lives in a
folder named after a hash of every source that a kernel is made of; a change of any of them compiles all anew (a minute).
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
import time
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent
_IMPORT = re.compile(r"^from sim_gateway\.(\w+) import", re.MULTILINE)
_KEEP_UNUSED_S = 24 * 3600.0


def kernel_sources(folder: Path = _PACKAGE) -> list[Path]:
    """The files of `folder` that define kernels, and those of the same folder that they import (constants, parameters)."""
    waiting = [path for path in folder.glob("*.py") if b"@njit" in path.read_bytes()]
    found: set[Path] = set()
    while waiting:
        path = waiting.pop()
        if path not in found and path.is_file():
            found.add(path)
            waiting += [folder / f"{name}.py" for name in _IMPORT.findall(path.read_text())]
    return sorted(found)


def sources_hash(folder: Path = _PACKAGE) -> str:
    """SHA-256 over names and contents of `kernel_sources`, 16 hexadecimal digits."""
    digest = hashlib.sha256()
    for path in kernel_sources(folder):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def use_cache_of_these_sources() -> Path | None:
    """Point numba to the folder of the present sources; must run before a kernel is defined. None: numba's own default.

    Whoever set NUMBA_CACHE_DIR, or installed the package where nothing can be written, keeps numba's default.
    """
    parent = _PACKAGE / "__pycache__"
    folder = parent / f"kernels-{sources_hash()}"
    if os.environ.get("NUMBA_CACHE_DIR", str(folder)) != str(folder):
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    except OSError:
        return None
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:  # imported before us: the environment has been read already
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    _forget_old(parent, folder)
    return folder


def _forget_old(parent: Path, current: Path) -> None:
    """Remove folders of earlier sources that nobody has used for a day."""
    for folder in parent.glob("kernels-*"):
        try:
            if folder != current and time.time() - folder.stat().st_mtime > _KEEP_UNUSED_S:
                shutil.rmtree(folder, ignore_errors=True)
        except OSError:
            continue
