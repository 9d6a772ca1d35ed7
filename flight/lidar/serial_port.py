"""A serial line, or a pseudo-terminal that stands in for one, as a `Transport`. Uses pyserial."""

from __future__ import annotations

import select
import time
from types import ModuleType

from flight.lidar.transport import READ_BYTES, TransportError


def _pyserial() -> ModuleType:
    try:
        import serial  # noqa: PLC0415  (only serial devices need it)
    except ImportError:
        raise TransportError("serial LiDARs need pyserial: pip install pyserial==3.5") from None
    module: ModuleType = serial
    return module


class SerialTransport:
    """A serial port, 8N1, ours alone. Raises `TransportError` when it cannot be opened.

    `gather_s`: after the first byte, wait this long for more: one read then takes several frames instead of waking for each.
    """

    def __init__(self, device: str, baud: int, gather_s: float = 0.0) -> None:
        self._name = device
        self._gather_s = gather_s
        serial = _pyserial()
        self._errors: tuple[type[Exception], ...] = (OSError, serial.SerialException, TypeError, ValueError)
        try:
            self._port = serial.Serial(device, baud, timeout=0, write_timeout=1.0, exclusive=True)
        except self._errors as error:
            raise TransportError(f"no LiDAR at {device}: {_reason(error)}") from error

    def read(self, timeout_s: float) -> bytes:
        """See `Transport.read`."""
        try:
            ready, _, _ = select.select([self._port.fileno()], [], [], max(timeout_s, 1e-3))
            if not ready:
                return b""
            if self._gather_s > 0.0:
                time.sleep(self._gather_s)
            data = bytes(self._port.read(READ_BYTES))
        except self._errors as error:
            raise TransportError(f"the link to {self._name} broke: {_reason(error)}") from error
        if not data:
            raise TransportError(f"the LiDAR at {self._name} is gone")
        return data

    def write(self, data: bytes, timeout_s: float) -> None:
        """See `Transport.write`."""
        try:
            if self._port.write_timeout != timeout_s:
                self._port.write_timeout = timeout_s
            self._port.write(data)
        except self._errors as error:
            raise TransportError(f"cannot write to {self._name}: {_reason(error)}") from error

    def set_dtr(self, level: bool) -> bool:
        """Set the DTR line (motor of some devices). Whether the port could: pseudo-terminals and some bridges have none."""
        try:
            self._port.dtr = level
        except self._errors:
            return False
        return True

    def close(self) -> None:
        """See `Transport.close`."""
        self._port.close()


def _reason(error: Exception) -> str:
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return f"{text} (is it plugged in, and are you in the group dialout?)" if isinstance(error, PermissionError) else text
