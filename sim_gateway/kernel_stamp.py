"""A fingerprint of source files, so that a cached compiled kernel is not used after one of the kernels it calls has changed.

numba's cache looks only at the file a kernel stands in, not at the files of the kernels compiled into it. Values that a
kernel closes over are part of the cache's key: a kernel made inside a function that takes this stamp, and that mentions
it, is compiled anew when any of the named sources differs.
"""

from __future__ import annotations

import hashlib
from importlib.resources import files


def source_stamp(*modules: str, package: str = "sim_gateway") -> str:
    """SHA-256 over the sources of `modules` of `package` (names without `.py`), as hexadecimal text."""
    digest = hashlib.sha256()
    for module in modules:
        digest.update(files(package).joinpath(f"{module}.py").read_bytes())
    return digest.hexdigest()
