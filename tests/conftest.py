"""One thread per library, and the same hypothesis examples in every run: the machines are shared, and coverage is a gate."""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from hypothesis import settings  # noqa: E402  (after the thread counts)

settings.register_profile("repeatable", derandomize=True, deadline=None)
if settings.get_current_profile_name() == "default":  # the mutation hunt brings its own
    settings.load_profile("repeatable")
