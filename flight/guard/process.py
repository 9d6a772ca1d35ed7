"""The guard as a process: relays bytes between the autopilot and MAVSDK, and turns the loop's commands into setpoints.

One thread, one `select`. In every turn time comes first, then the loop, then the vehicle, then MAVSDK, each in bounded
portions, so that neither a flood from outside nor a backlog after a pause can hold up what matters.
"""

from __future__ import annotations

import contextlib
import gc
import math
import os
import select
import signal
import socket
import time
from collections.abc import Callable, Iterator

from flight.guard.channel import MAX_MESSAGE_BYTES, Answer, Engage, Kind, pack_answer, read_request
from flight.guard.core import STILL, Command, GuardCore, State, Velocity
from flight.guard.ports import CHUNK_BYTES, Address, Port, PortError, open_port
from flight.guard.wire import STEERING, pack_setpoint, read_frames, read_mode

OWN_IDS = (245, 192)
"""System of `fly`, component MAV_COMP_ID_ONBOARD_COMPUTER2: MAVSDK counts its messages as 245/191, and so must its receiver."""

OPEN_DEADLINE_S = 10.0
IDLE_WAIT_S = 1.0
PORTION = 32
"""Messages taken from one side in one turn."""

LOOPBACK = "127.0.0.1"


class GuardProcess:
    """Joins the core with its three sockets. `run` returns when the loop's process is gone and the vehicle braked."""

    def __init__(
        self, control: socket.socket, port: Port, relay: socket.socket, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.core = GuardCore()
        self.dropped = 0
        self._control, self._port, self._relay, self._clock = control, port, relay, clock
        self._mavsdk: Address | None = None
        self._target = (0, 0)
        self._frames = 0
        self._last = Answer(State.IDLE, self.core.reason, 0, 0, math.nan, 0)
        self._terminated = self._loop_gone = False
        for end in (control, relay):
            end.setblocking(False)

    def on_signal(self, _number: int, _frame: object) -> None:
        """SIGTERM: noted here, acted upon in the next turn."""
        self._terminated = True

    def run(self, wake: int) -> None:
        """Serve until the end. `wake`: descriptor on which signals show. Raises `PortError` when the wire has ended."""
        poll = select.poll()
        for descriptor in (wake, self._control.fileno(), self._port.fileno(), self._relay.fileno()):
            poll.register(descriptor, select.POLLIN)
        while not self.core.finished:
            wait_s = min(self.core.next_s() - self._clock(), IDLE_WAIT_S)
            ready = {descriptor for descriptor, _ in poll.poll(max(0, math.ceil(1e3 * wait_s)))}
            alone = self.core.orphaned
            self.turn(ready)
            if wake in ready:
                _drain(wake)
            if self.core.orphaned and not alone:
                poll.unregister(self._control.fileno())

    def turn(self, ready: set[int]) -> None:
        """One round of work on the descriptors that are readable."""
        if self._terminated:
            self._terminated = False
            self.core.terminate(self._clock())
        self._brake()
        if self._control.fileno() in ready:
            self._serve_loop()
        if self._port.fileno() in ready:
            self._from_vehicle()
        if self._relay.fileno() in ready:
            self._from_mavsdk()
        self._tell_changes()

    # -- setpoints

    def _serve_loop(self) -> None:
        """What the loop has sent. Of commands in a row only the newest counts: after a pause nothing is caught up with."""
        waiting: Command | None = None
        for message in self._messages():
            if waiting is not None:
                self._answer(waiting.sequence, math.nan)
                waiting = None
            request = read_request(message)
            if isinstance(request, Command):
                waiting = request
            elif isinstance(request, Engage):
                self._target = request.target
                self.core.engage(request.engagement)
                self._answer(0, math.nan)
            else:
                self.core.disengage()
        if waiting is not None:
            self._follow(waiting)
        if self._loop_gone:
            self.core.orphan(self._clock())
            self._brake()

    def _messages(self) -> Iterator[bytes]:
        for _ in range(PORTION):
            try:
                message = self._control.recv(MAX_MESSAGE_BYTES)
            except BlockingIOError:
                return
            except OSError:
                message = b""
            if not message:
                self._loop_gone = True
                return
            yield message

    def _follow(self, command: Command) -> None:
        """Send one command if it may go out. The frame is made before the look at the clock, the send comes straight after it."""
        frame = self._frame(command.setpoint)
        sent_s = math.nan
        if self.core.admit(command, self._clock()):
            gone = self._port.send(frame, urgent=True)
            now_s = self._clock()
            self._frames += 1
            sent_s = now_s if gone else math.nan
            if self.core.overran(command, now_s):
                self._send_still()
        self._answer(command.sequence, sent_s)

    def _brake(self) -> None:
        if self.core.brake_due(self._clock()):
            self._send_still()

    def _send_still(self) -> None:
        self._port.send(self._frame(STILL), urgent=True)
        self._frames += 1

    def _frame(self, setpoint: Velocity) -> bytes:
        boot_ms = int(self._clock() * 1e3)
        try:
            return pack_setpoint(self._frames, boot_ms, OWN_IDS, self._target, setpoint[:3], setpoint[3])
        except OverflowError:  # finite, but no float32: braking is what is left
            return pack_setpoint(self._frames, boot_ms, OWN_IDS, self._target, STILL[:3], 0.0)

    def _answer(self, sequence: int, sent_s: float) -> None:
        core = self.core
        self._last = Answer(core.state, core.reason, core.engagement, sequence, sent_s, core.braked)
        with contextlib.suppress(OSError):  # a loop that does not read has no use for it
            self._control.send(pack_answer(self._last))

    def _tell_changes(self) -> None:
        core = self.core
        if (core.state, core.reason, core.braked) != (self._last.state, self._last.reason, self._last.braked):
            self._answer(0, math.nan)

    # -- the relay

    def _from_vehicle(self) -> None:
        for _ in range(PORTION):
            datagrams = self._port.receive()
            if not datagrams:
                return
            for data in datagrams:
                self._to_mavsdk(data)
                for frame in read_frames(data)[0]:
                    report = read_mode(frame)
                    if report is not None and report.system == self._target[0]:
                        self.core.heard(report)

    def _to_mavsdk(self, data: bytes) -> None:
        if self._mavsdk is not None:
            with contextlib.suppress(OSError):
                self._relay.sendto(data, self._mavsdk)

    def _from_mavsdk(self) -> None:
        for _ in range(PORTION):
            try:
                data, sender = self._relay.recvfrom(CHUNK_BYTES)
            except OSError:
                return
            if self._mavsdk is None:
                self._mavsdk = sender
            if sender != self._mavsdk:
                continue
            frames, _ = read_frames(data)
            kept = [frame.raw for frame in frames if frame.message_id not in STEERING]
            self.dropped += len(frames) - len(kept)
            if kept:
                self._port.send(b"".join(kept))


def _drain(descriptor: int) -> None:
    with contextlib.suppress(BlockingIOError):
        os.read(descriptor, CHUNK_BYTES)


def serve(url: str, control: socket.socket, priority: int) -> None:
    """Open the wire, tell the loop where to connect MAVSDK, and guard until the end."""
    try:
        port = open_port(url, OPEN_DEADLINE_S)
    except PortError as error:
        control.send(bytes((Kind.ERROR,)) + str(error).encode()[: MAX_MESSAGE_BYTES - 1])
        return
    relay = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    relay.bind((LOOPBACK, 0))
    guard = GuardProcess(control, port, relay)
    wake, wake_up = os.pipe()
    for end in (wake, wake_up):
        os.set_blocking(end, False)
    signal.set_wakeup_fd(wake_up, warn_on_full_buffer=False)
    signal.signal(signal.SIGTERM, guard.on_signal)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for `fly`, which lands
    _be_quick(priority)
    with contextlib.suppress(OSError):  # a loop that is gone by now shows as the end of the socket
        control.send(bytes((Kind.READY,)) + relay.getsockname()[1].to_bytes(2, "little"))
    with contextlib.suppress(PortError):  # the end of the wire is the end of this process: the loop sees that
        guard.run(wake)


def _be_quick(priority: int) -> None:
    """First on the processor where that is permitted, and no garbage collection: nothing here makes cycles."""
    gc.collect()
    gc.freeze()
    gc.disable()
    if priority:
        with contextlib.suppress(OSError, AttributeError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
