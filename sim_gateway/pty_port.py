"""A pseudo-terminal whose other end is given to a serial driver as its device. Nothing blocks; no thread."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import tty
from pathlib import Path

_READ_BYTES = 4096


class PtyPort:
    """The device's end of a serial line. What a client does not read in time is lost, as on a real line.

    `link`: a symbolic link to the client's end, made anew, so that a mission can name it. Raises `OSError` if it cannot.
    """

    def __init__(self, link: Path | None = None) -> None:
        self._ours, self._theirs = pty.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self.path = os.ttyname(self._theirs)
        self.lost_bytes = 0
        self._link = link
        if link is not None:
            if link.is_symlink():
                link.unlink()
            link.symlink_to(self.path)

    def read(self, most: int = _READ_BYTES) -> bytes:
        """What a client has sent since the last call, up to `most` bytes."""
        try:
            return os.read(self._ours, most) if most > 0 else b""
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> int:
        """Send, or lose what the line cannot take: all of it is done with."""
        if not data:
            return 0
        try:
            written = os.write(self._ours, data)
        except BlockingIOError:
            written = 0
        self.lost_bytes += len(data) - written
        return len(data)

    def wait(self, timeout_s: float) -> bool:
        """Whether a client has sent something within `timeout_s`."""
        return bool(select.select([self._ours], [], [], timeout_s)[0])

    def close(self) -> None:
        """Take the line away; safe to call twice."""
        for name in ("_ours", "_theirs"):
            descriptor = getattr(self, name)
            if descriptor >= 0:
                setattr(self, name, -1)
                os.close(descriptor)
        if self._link is not None and self._link.is_symlink():
            with contextlib.suppress(OSError):
                self._link.unlink()
            self._link = None

    def __enter__(self) -> PtyPort:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
