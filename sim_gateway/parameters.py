"""PX4's parameters: names, types, defaults, and their encoding in the MAVLink parameter protocol.

The names and defaults in `px4_parameters.json` are those that a PX4 v1.17 SITL (airframe 10040) listed. Only some of them
change what the gateway does (see docs/gateway.md); the others are stored and read back like the real ones.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Mapping
from importlib import resources

# MAV_PARAM_TYPE
UINT32, INT32, REAL32 = 5, 6, 9
HASH_NAME = "_HASH_CHECK"
HASH_INDEX = 65535
_INT32_RANGE = range(-(2**31), 2**31)


class UnknownParameterError(KeyError):
    """No parameter has this name."""


class ParameterStore:
    """The parameters of one vehicle: read and written by name; the index is the place in the sorted list, as in PX4."""

    def __init__(self, overrides: Mapping[str, float] | None = None) -> None:
        text = resources.files("sim_gateway").joinpath("px4_parameters.json").read_text(encoding="utf-8")
        table: dict[str, list[float | str]] = json.loads(text)
        self._types = {name: INT32 if kind == "INT32" else REAL32 for name, (kind, _) in table.items()}
        self._values = {name: float(value) for name, (_, value) in table.items()}
        self.names: tuple[str, ...] = tuple(sorted(self._types))
        self._index = {name: i for i, name in enumerate(self.names)}
        for name, value in (overrides or {}).items():
            self.set(name, value)

    def __len__(self) -> int:
        return len(self.names)

    def __contains__(self, name: str) -> bool:
        return name in self._types

    def get(self, name: str) -> float:
        """The value; raises `UnknownParameterError`."""
        try:
            return self._values[name]
        except KeyError:
            raise UnknownParameterError(f"no parameter is called {name!r}") from None

    def set(self, name: str, value: float) -> None:
        """Write a value. Like PX4 it is not checked against a range; an INT32 parameter takes whole numbers only."""
        if name not in self._types:
            raise UnknownParameterError(f"no parameter is called {name!r}")
        if self._types[name] == INT32 and (not math.isfinite(value) or int(value) not in _INT32_RANGE or value != int(value)):
            raise ValueError(f"parameter {name} takes a 32-bit whole number, not {value!r}")
        self._values[name] = float(value)

    def type_of(self, name: str) -> int:
        """MAV_PARAM_TYPE of the parameter."""
        return self._types[name]

    def index_of(self, name: str) -> int:
        """Place in the sorted list."""
        return self._index[name]

    def wire_value(self, name: str) -> float:
        """The float that PARAM_VALUE carries: PX4 puts the bytes of an integer into the float field."""
        value = self.get(name)
        return float(struct.unpack("<f", struct.pack("<i", int(value)))[0]) if self._types[name] == INT32 else value

    def set_from_wire(self, name: str, wire_value: float, param_type: int) -> bool:
        """Apply a PARAM_SET. Unknown names and wrong types change nothing and get no answer (as recorded): returns False.

        A REAL32 that is not finite is refused in the same way: it would disable every comparison it is used in.
        """
        if self._types.get(name) != param_type or (param_type == REAL32 and not math.isfinite(wire_value)):
            return False
        if param_type == INT32:
            self._values[name] = float(struct.unpack("<i", struct.pack("<f", wire_value))[0])
        else:
            self._values[name] = float(wire_value)
        return True

    def hash_wire_value(self) -> float:
        """Fingerprint of names and values, in the byte-wise encoding; a client uses it to skip the download of a known list."""
        crc = 0
        for name in self.names:
            packed = (
                struct.pack("<i", int(self._values[name]))
                if self._types[name] == INT32
                else struct.pack("<f", self._values[name])
            )
            crc = zlib.crc32(packed, zlib.crc32(name.encode(), crc))
        return float(struct.unpack("<f", struct.pack("<I", crc))[0])
