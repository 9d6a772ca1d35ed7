"""What reading weights with torch's restricted reader may raise. Needs no torch."""

from __future__ import annotations

import pickle
import struct
import zipfile

# What torch's restricted unpickler raises on damaged files, seen by cutting and flipping bytes.
UNREADABLE = (
    OSError,
    RuntimeError,
    ValueError,
    EOFError,
    LookupError,
    TypeError,
    AttributeError,
    AssertionError,
    OverflowError,
    MemoryError,
    struct.error,
    zipfile.BadZipFile,
    pickle.UnpicklingError,
)
