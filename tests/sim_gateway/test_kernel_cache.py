"""Compiled kernels are kept per state of their sources."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import sim_gateway
from sim_gateway.kernel_cache import kernel_sources, sources_hash

HOUSE = Path(sim_gateway.__file__).parent
KERNEL = "from numba import njit\nfrom sim_gateway.numbers import TWO\n\n@njit(cache=True)\ndef f(x):\n    return TWO * x\n"


def test_every_file_a_kernel_is_made_of_counts_and_no_other() -> None:
    names = {path.name for path in kernel_sources()}
    assert {"vehicle.py", "vehicle_params.py", "raycast.py", "collision.py", "estimate.py", "readings.py"} <= names
    assert not {"cli.py", "mavlink_server.py", "autopilot.py"} & names


def test_a_changed_constant_of_another_file_changes_the_folder(tmp_path: Path) -> None:
    (tmp_path / "kernel.py").write_text(KERNEL)
    (tmp_path / "numbers.py").write_text("TWO = 2.0\n")
    (tmp_path / "unrelated.py").write_text("A = 1\n")
    before = sources_hash(tmp_path)
    (tmp_path / "unrelated.py").write_text("A = 2\n")
    assert sources_hash(tmp_path) == before
    (tmp_path / "numbers.py").write_text("TWO = 2.5\n")
    assert sources_hash(tmp_path) != before


def test_numba_uses_the_folder_even_if_it_was_imported_first() -> None:
    code = "import numba, sim_gateway.raycast as r, sim_gateway.kernel_cache as k; print(r.cast_beams._cache.cache_path)"
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    run = [sys.executable, "-c", code]
    done = subprocess.run(run, cwd=HOUSE.parent, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert f"kernels-{sources_hash()}" in done.stdout, done.stderr
