"""The loop's end of the guard: starts it, hands it commands, and notices at once when it is gone."""

from __future__ import annotations

import contextlib
import math
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

from flight.errors import NoVehicleError, RefusedError, VehicleCommandError
from flight.guard.channel import (
    MAX_MESSAGE_BYTES,
    Answer,
    Engage,
    Kind,
    pack_command,
    pack_disengage,
    pack_engage,
    read_answer,
)
from flight.guard.core import Command, Reason, State, Velocity

ROOT = Path(__file__).resolve().parents[2]
ANSWER_WAIT_S = 0.005
MAX_UNANSWERED = 3
"""Commands in a row without an answer before the guard counts as hung: 150 ms at 20 Hz. A pause of `fly` is no such row."""

ENGAGE_DEADLINE_S = 1.0
STOP_DEADLINE_S = 1.0
POLL_S = 0.05


class GuardLostError(VehicleCommandError):
    """The guard died or hangs, and with it the wire to the vehicle."""


class SetpointGuard:
    """A running guard. Context manager: leaving it ends the guard.

    `url` is the vehicle's; MAVSDK connects to `relay_url` once `start` has returned. `fifo_priority`: the guard's, 0 for usual.
    """

    def __init__(self, url: str, fifo_priority: int = 0) -> None:
        self.url = url
        self.relay_url = ""
        self.answer: Answer | None = None
        self._priority = fifo_priority
        self._child: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._engagement = self._sequence = 0
        self._answered = 0
        self._sent_s = math.nan
        self._lost: str | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def start(self, timeout_s: float, keep_waiting: Callable[[], None] | None = None) -> None:
        """Start it and wait until the wire is open. Raises `RefusedError` with the reason, `NoVehicleError` after `timeout_s`."""
        own, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with other:
            self._child = subprocess.Popen(
                # -S -P: nothing but the standard library and this package can be imported, which also starts faster
                [sys.executable, "-S", "-P", "-m", "flight.guard", self.url, str(other.fileno()), str(self._priority)],
                env=os.environ | {"PYTHONPATH": str(ROOT)},
                pass_fds=(other.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C in the terminal is for `fly`, which needs the guard to land
            )
        self._control = own
        own.settimeout(POLL_S)
        message = self._first_word(own, time.monotonic() + timeout_s, keep_waiting)
        own.setblocking(False)
        if message[:1] == bytes((Kind.ERROR,)):
            raise RefusedError(f"cannot open {self.url}: {message[1:].decode('utf-8', 'replace')}")
        self.relay_url = f"udpout://127.0.0.1:{int.from_bytes(message[1:3], 'little')}"

    def _first_word(self, control: socket.socket, deadline: float, keep_waiting: Callable[[], None] | None) -> bytes:
        while time.monotonic() < deadline:
            if keep_waiting is not None:
                keep_waiting()
            with contextlib.suppress(TimeoutError):
                message = control.recv(MAX_MESSAGE_BYTES)
                if not message:
                    raise RefusedError(f"the guard for {self.url} did not start: see its error above")
                return message
        raise NoVehicleError(f"{self.url} could not be opened in time: check address, cable and power")

    @property
    def pid(self) -> int | None:
        """Process id while it runs."""
        return self._child.pid if self._child is not None else None

    # -- setpoints

    def engage(self, target: tuple[int, int]) -> None:
        """Begin a new engagement: from now on commands are followed. Raises `GuardLostError` or `VehicleCommandError`."""
        self._engagement += 1
        self._sequence = self._answered = 0
        self._send(pack_engage(Engage(self._engagement, target)))
        self._wait_for(lambda: self.answer is not None and self.answer.engagement == self._engagement, ENGAGE_DEADLINE_S)
        if self._lost is not None:
            raise GuardLostError(self._lost)
        if self.answer is None or self.answer.engagement != self._engagement:
            raise VehicleCommandError("the guard takes no engagement: it was told to end, or does not answer")

    def command(self, setpoint: Velocity, stamp_s: float) -> float | None:
        """Hand over a command decided at `stamp_s`; returns when it went out, None when the guard did not let it.

        An answer that takes longer than 5 ms is not waited for: then it counts as sent now. Raises `GuardLostError`.
        """
        self._sequence += 1
        self._send(pack_command(Command(self._engagement, self._sequence, stamp_s, setpoint)))
        self._wait_for(lambda: self._answered == self._sequence, ANSWER_WAIT_S)
        if self._lost is not None:
            raise GuardLostError(self._lost)
        if self._answered < self._sequence:
            return time.monotonic()
        return None if math.isnan(self._sent_s) else self._sent_s

    def disengage(self) -> None:
        """Silence at once. Never raises."""
        if self._control is not None and self._engagement:
            with contextlib.suppress(OSError):
                self._control.send(pack_disengage())

    # -- what it says

    @property
    def state(self) -> State:
        """What the guard is doing, by its newest word."""
        self.look()
        return self.answer.state if self.answer is not None else State.IDLE

    @property
    def reason(self) -> Reason:
        """Why it brakes or is silent."""
        return self.answer.reason if self.answer is not None else Reason.NONE

    @property
    def lost(self) -> str | None:
        """Why the guard cannot be used any more, None while it can. Latched."""
        self.look()
        return self._lost

    def look(self) -> None:
        """Read all that the guard has said."""
        while self._control is not None and self._lost is None:
            try:
                message = self._control.recv(MAX_MESSAGE_BYTES)
            except BlockingIOError:
                break
            except OSError:
                message = b""
            if not message:
                self._give_up("has ended")
                return
            self._hear(read_answer(message))
        if self._lost is None and self._sequence - self._answered > MAX_UNANSWERED:
            self._give_up("hangs")

    def _hear(self, answer: Answer | None) -> None:
        if answer is None:
            return
        self.answer = answer
        if answer.engagement == self._engagement and answer.sequence > self._answered:
            self._answered, self._sent_s = answer.sequence, answer.sent_s

    def _wait_for(self, condition: Callable[[], bool], timeout_s: float) -> None:
        """Read what the guard says until `condition` holds, the guard is gone or time is over."""
        deadline = time.monotonic() + timeout_s
        self.look()
        while self._control is not None and self._lost is None and not condition():
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                return
            select.select([self._control], [], [], left_s)
            self.look()

    # -- the end

    def close(self) -> None:
        """End the relay and the process, by force where need be. An engagement still open is braked first. Idempotent."""
        control, self._control = self._control, None
        if control is not None:
            control.close()
        child, self._child = self._child, None
        if child is None:
            return
        try:
            child.wait(STOP_DEADLINE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()

    def _give_up(self, why: str) -> None:
        """The guard is gone or hangs. A hanging one must not come back after `fly` has given up: it is killed."""
        self._lost = f"the guard process {why}, and with it the link to the vehicle: PX4's own loss action flies"
        if self._child is not None:
            self._child.kill()

    def _send(self, message: bytes) -> None:
        if self._control is None:
            raise GuardLostError("the guard is not running")
        try:
            self._control.send(message)
        except BlockingIOError:
            return  # it reads no more: the missing answers will tell
        except OSError:
            self._give_up("has ended")
            raise GuardLostError(self._lost) from None
