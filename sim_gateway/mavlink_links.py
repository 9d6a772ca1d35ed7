"""The vehicle's side of a MAVLink link: what it streams, whom it answers, what arrives. UDP or in memory; others: `stream_links`.

Nothing blocks; everything that could grow is bounded. The link's quality and link faults act here, on whole messages.
"""

from __future__ import annotations

import errno
import heapq
import logging
import math
import socket
import struct
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator

from pymavlink.dialects.v20 import development as mav

from sim_gateway.autopilot_output import StatusText
from sim_gateway.link_conditions import LinkConditions
from sim_gateway.link_faults import LinkFaults, RawBytes
from sim_gateway.link_spec import LOOPBACK
from sim_gateway.mavlink_frame import FramePacker
from sim_gateway.stream_rates import STREAM_RATES_HZ
from sim_gateway.telemetry import COMPONENT_ID, SYSTEM_ID, Message

_ANY_ADDRESS = "0.0.0.0"
_MAX_DATAGRAM = 4096
_DATAGRAMS_PER_POLL = 100  # more wait in the socket's own, bounded, buffer
_PEERS_PER_LINK = 8
_PEER_TIMEOUT_S = 10.0
_GCS_TIMEOUT_S = 5.0
_TEXT_CHUNK = 50
_MIN_INTERVAL_US = 1000.0
_LOOK_AGAIN_S = 0.02  # whether a message that start-up has not reached can be sent now
_MEMORY_MESSAGES = 100_000

_log = logging.getLogger("sim_gateway.mavlink")


class PortInUseError(OSError):
    """A port the gateway needs is taken; the message names it."""


def _bind(host: str, port: int, purpose: str) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    try:
        sock.bind((host, port))
    except OSError as error:
        sock.close()
        reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
        raise PortInUseError(f"UDP port {port} ({purpose}) {reason}") from error
    return sock


class MavlinkLink(ABC):
    """One link: its streams and its faults. What carries the messages is in the classes below."""

    def __init__(self, name: str, column: int, now_s: Callable[[], float]) -> None:
        self.name = name
        self.faults: LinkFaults | None = None
        self.conditions: LinkConditions | None = None
        self._now_s = now_s
        self._defaults = {n: 1.0 / rates[column] for n, rates in STREAM_RATES_HZ.items() if rates[column] > 0}
        self.streams = dict(self._defaults)  # name: interval, s
        self._queue = [(0.0, name, 0.0) for name in self.streams]  # a heap: when to look, what, since when it is due
        self.parameter_queue: deque[str] = deque()
        self.gcs_heard_s = -math.inf
        self._text_id = 0

    @property
    def has_gcs(self) -> bool:
        """Whether a ground station's heartbeat came lately: only then PX4 sends STATUSTEXT here."""
        return self._now_s() - self.gcs_heard_s < _GCS_TIMEOUT_S

    @property
    def has_room(self) -> bool:
        """Whether streams and parameters may be sent now: a slow line takes them as it gets them off."""
        return True

    @property
    def limited(self) -> bool:
        """Whether there may be no room."""
        return False

    def watched(self) -> list[socket.socket]:
        """What becomes readable when something arrives."""
        return []

    def close(self) -> None:  # noqa: B027  (most links hold nothing)
        """Let go of what carries the messages."""

    # ---- out

    def send(self, message: Message) -> None:
        """Send to everyone on the link, through its faults and as well as its quality allows."""
        if self.faults is None:
            self._convey(message)
            return
        for leaving in self.faults.out(message, self._now_s()):
            self._convey(leaving)

    def _convey(self, message: Message | RawBytes) -> None:
        if self.conditions is None:
            self._transmit(message)
            return
        for leaving in self.conditions.out(message, self._now_s()):
            self._transmit(leaving)

    def flush(self) -> None:
        """Send what was kept back until now, and what link faults add by themselves."""
        if self.faults is not None:
            for leaving in self.faults.due_out(self._now_s()):
                self._convey(leaving)
        if self.conditions is not None:
            for leaving in self.conditions.due_out(self._now_s()):
                self._transmit(leaving)

    @abstractmethod
    def _transmit(self, message: Message | RawBytes) -> None:
        """Put one message on the wire."""

    def send_text(self, text: StatusText) -> None:
        """STATUSTEXT in pieces of 50 characters; like PX4's, a text that fills its last piece is followed by an empty one."""
        data = text.text.encode("ascii", "replace")
        if len(data) < _TEXT_CHUNK:
            self.send(mav.MAVLink_statustext_message(text.severity, data))
            return
        self._text_id = self._text_id % 0xFFFF + 1
        for chunk in range(min(len(data) // _TEXT_CHUNK + 1, 255)):
            piece = data[chunk * _TEXT_CHUNK : (chunk + 1) * _TEXT_CHUNK]
            self.send(mav.MAVLink_statustext_message(text.severity, piece, self._text_id, chunk))

    def set_interval(self, name: str, interval_us: float) -> None:
        """Stream `name` at this interval: 0 its default, negative off. Faster than 1 kHz is not possible."""
        interval_s = self._defaults.get(name, -1.0) if interval_us == 0 else max(interval_us, _MIN_INTERVAL_US) * 1e-6
        self._queue = [entry for entry in self._queue if entry[1] != name]
        self.streams.pop(name, None)
        if interval_us >= 0 and interval_s >= 0:
            self.streams[name] = interval_s
            self._queue.append((self._now_s(), name, self._now_s()))
        heapq.heapify(self._queue)

    def interval_us(self, name: str) -> int:
        """The interval in force; -1 when the message is not streamed."""
        return round(self.streams[name] * 1e6) if name in self.streams else -1

    def due(self, available: Callable[[str], bool]) -> Iterator[str]:
        """Names of the messages whose time has come, the longest waiting first, as long as there is room on the link.

        A stream that fell behind by more than its interval skips what it missed.
        """
        now_s, queue = self._now_s(), self._queue
        again: list[tuple[float, str, float]] = []
        while queue and queue[0][0] <= now_s + 1e-9 and self.has_room:
            _, name, due_s = heapq.heappop(queue)
            if not available(name):
                again.append((now_s + _LOOK_AGAIN_S, name, due_s))
                continue
            yield name
            behind = now_s - due_s > self.streams[name]
            next_s = (now_s if behind else due_s) + self.streams[name]
            again.append((next_s, name, next_s))
        for entry in again:
            heapq.heappush(queue, entry)

    # ---- in

    def receive(self) -> list[Message]:
        """The valid messages that have arrived, as well as the link's quality allows and through its faults."""
        arrived = self._fetch()
        if self.conditions is not None:
            arrived = self.conditions.into(arrived, self._now_s())
        return arrived if self.faults is None else self.faults.into(arrived, self._now_s())

    @abstractmethod
    def _fetch(self) -> list[Message]:
        """The valid messages that have come over the wire."""


class UdpLink(MavlinkLink):
    """A UDP link: to its default client and to every loopback address that has spoken to it lately.

    Nobody else is heard: from other machines only the default client, `host`, and only if that is not on this one.
    """

    def __init__(
        self,
        name: str,
        own_port: int,
        client_port: int,
        column: int,
        now_s: Callable[[], float],
        system_id: int = SYSTEM_ID,
        host: str = LOOPBACK,
    ) -> None:
        super().__init__(name, column, now_s)
        self.socket = _bind(LOOPBACK if _is_loopback(host) else _ANY_ADDRESS, own_port, f"{name} link")
        self._client = (host, client_port)
        self._peers: dict[tuple[str, int], float] = {}
        self._packer = FramePacker(system_id, COMPONENT_ID)

    def watched(self) -> list[socket.socket]:
        """See `MavlinkLink.watched`."""
        return [self.socket]

    def close(self) -> None:
        """Free the port."""
        self.socket.close()

    def _transmit(self, message: Message | RawBytes) -> None:
        """To all peers; a full or unreachable socket loses the message, as UDP does."""
        try:
            data = message.data if isinstance(message, RawBytes) else self._packer.pack(message)
        except (struct.error, OverflowError, ValueError) as error:
            _log.error("message %s has a value outside its field: %s", type(message).__name__, error)
            return
        for peer in (self._client, *self._peers):
            try:
                self.socket.sendto(data, peer)
            except OSError as error:
                _log.debug("message to %s lost: %s", peer, error)

    def _fetch(self) -> list[Message]:
        """The valid messages that have arrived; bad bytes, wrong checksums and foreign hosts are dropped."""
        messages: list[Message] = []
        self._forget_silent_peers()
        for _ in range(_DATAGRAMS_PER_POLL):
            try:
                data, peer = self.socket.recvfrom(_MAX_DATAGRAM + 1)
            except BlockingIOError:
                break
            except OSError as error:
                _log.debug("receiving on the %s link: %s", self.name, error)
                continue
            whole = len(data) <= _MAX_DATAGRAM  # of a longer one the rest is lost: none of it is taken
            found = _parse(data) if whole and self._is_heard(peer[0]) else []
            if found:
                self._remember(peer)
            messages.extend(found)
        return messages

    def _is_heard(self, address: str) -> bool:
        return _is_loopback(address) or address == self._client[0]

    def _remember(self, peer: tuple[str, int]) -> None:
        """Answer a client on another port too, for as long as it speaks."""
        known = peer in self._peers or len(self._peers) < _PEERS_PER_LINK
        if peer != self._client and known and _is_loopback(peer[0]):
            self._peers[peer] = self._now_s()

    def _forget_silent_peers(self) -> None:
        if self._peers:
            oldest_s = self._now_s() - _PEER_TIMEOUT_S
            self._peers = {peer: heard_s for peer, heard_s in self._peers.items() if heard_s >= oldest_s}


class MemoryLink(MavlinkLink):
    """A link inside this process, for lockstep: the client takes from `outbox` and puts packed messages into `inbox`."""

    def __init__(self, name: str, column: int, now_s: Callable[[], float]) -> None:
        super().__init__(name, column, now_s)
        self.outbox: deque[Message | RawBytes] = deque(maxlen=_MEMORY_MESSAGES)
        self.inbox: deque[Message] = deque(maxlen=_MEMORY_MESSAGES)

    def _transmit(self, message: Message | RawBytes) -> None:
        self.outbox.append(message)

    def _fetch(self) -> list[Message]:
        arrived = list(self.inbox)
        self.inbox.clear()
        return arrived


def _is_loopback(address: str) -> bool:
    return address.startswith("127.")


def _parse(data: bytes) -> list[Message]:
    """Messages of one datagram. A fresh parser each time: a truncated frame cannot swallow the next datagram."""
    parser = mav.MAVLink(None)
    parser.robust_parsing = True
    try:
        found = parser.parse_buffer(data) or []
    except (mav.MAVError, struct.error, ValueError, IndexError) as error:
        _log.debug("datagram dropped: %s", error)
        return []
    return [message for message in found if message.get_type() != "BAD_DATA" and not message.get_type().startswith("UNKNOWN")]
