"""Live sources: sockets read without waiting, packets that count, health, recordings."""

import ipaddress
import socket
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any

import numpy as np

from ...errors import StgaError
from .. import performance_files
from ..clocks import DEFAULT_FPS, MAX_FPS
from ..frame_forms import MAX_ROWS
from ..open_motion import MotionOptions, corrected
from ..performance import FacePacket, Performance
from .decoders import Received, decode_live_link_face, decode_vmc

Decoded = tuple[FacePacket | None, Any]
"""The frame that a datagram completes, if any, and what is known of its sender from then on."""


@dataclass(frozen=True)
class Source:
    """A protocol on UDP.

    port     standard port
    decode   datagram and what is known of its sender (None at first) -> `Decoded`; None for bytes
             of another kind
    request  what is sent to the phone to make it send, on the same port; b"" for sources that send
             by themselves
    hint     what a user has to know
    """

    label: str
    port: int
    decode: Callable[[bytes, Any], Decoded | None]
    request: bytes = b""
    hint: str = ""


def _single(decode: Callable[[bytes], FacePacket | None]) -> Callable[[bytes, Any], Decoded | None]:
    """A decoder of datagrams that are frames by themselves."""
    return lambda data, _: None if (packet := decode(data)) is None else (packet, None)


SOURCES = {
    "live_link_face": Source(
        "Live Link Face",
        11111,
        _single(decode_live_link_face),
        hint="Choose the mode Live Link (ARKit) in the app; its MetaHuman Animator mode sends no "
        "such weights",
    ),
    "facial_mocap": Source(
        "iFacialMocap",
        49983,
        _single(performance_files.parse_packet),
        performance_files.REQUEST,
        "A request is sent to the phone, which answers until it is closed",
    ),
    "vmc": Source(
        "VMC (OSC)",
        39539,
        lambda data, known: decode_vmc(data, known or Received()),
        hint="The sender must send ARKit's shapes (\"perfect sync\"); VRM's own expressions are "
        "left out",
    ),
}
"""Identifier of a source in Blender -> its protocol."""


LOOPBACK = "127.0.0.1"
"""Address that receives from programs on this computer alone."""

MAX_DATAGRAM_BYTES = 1 << 14
"""Size of a source's frame; larger packets are foreign."""
MAX_DATAGRAMS = 256
"""Read at once, more than a socket keeps."""
MAX_READ_BYTES = 1 << 15
"""Read at once; the rest waits in the socket, so that decoding a flood does not hold Blender up."""
REQUEST_INTERVAL_S = 1.0  # Interval at which a silent phone is asked again


class Receiver:
    """An open UDP socket. Close it with `close`."""

    def __init__(
        self, source: Source, address: str = LOOPBACK, port: int = 0, phone: str = ""
    ) -> None:
        """Listen on `address` and `port` (0: the standard one); phone: whom a source with a request
        asks. Raises StgaError for no address, or a port that cannot be opened."""
        self.source = source
        self.port = port or source.port
        self.phone = str(checked_address("phone's address", phone)) if source.request else ""
        where = checked_address("address to listen on", address)
        self._asked = float("-inf")
        family = socket.AF_INET6 if where.version == 6 else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.bind((str(where), self.port))
        except OSError as error:
            self._socket.close()
            raise StgaError(
                f"{source.label}: port {self.port} of {where} cannot be opened "
                f"({error.strerror or error}); another program may be listening on it, or this "
                "computer has no such address"
            ) from error
        self.port = self._socket.getsockname()[1]

    def read(self) -> list[tuple[str, bytes]]:
        """Sender's address and bytes of the datagrams that wait, up to MAX_DATAGRAMS and
        MAX_READ_BYTES; of those that are too long, a byte more than MAX_DATAGRAM_BYTES."""
        found: list[tuple[str, bytes]] = []
        size = 0
        # nothing waits; or Windows: a request did not reach the phone, a datagram is too long
        with suppress(OSError):
            while len(found) < MAX_DATAGRAMS and size < MAX_READ_BYTES:
                data, sender = self._socket.recvfrom(MAX_DATAGRAM_BYTES + 1)
                found.append((sender[0], data))
                size += len(data) if len(data) <= MAX_DATAGRAM_BYTES else 0
        return found

    def ask(self, now: float) -> None:
        """Send the source's request to the phone, once per REQUEST_INTERVAL_S at most."""
        if self.phone and now - self._asked >= REQUEST_INTERVAL_S:
            self._asked = now
            with suppress(OSError):  # unreachable at the moment: the phone counts as silent
                self._socket.sendto(self.source.request, (self.phone, self.source.port))

    def close(self) -> None:
        self._socket.close()


def checked_address(what: str, text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """An IP address. Raises StgaError for anything else; `what` names it."""
    try:
        return ipaddress.ip_address(text.strip())
    except ValueError as error:
        raise StgaError(f"{what}: {text!r} is no IP address, such as {LOOPBACK}") from error


def leaves_this_machine(source: Source, address: str, phone: str) -> bool:
    """Whether listening, or asking the phone, involves other machines."""
    if not checked_address("address to listen on", address).is_loopback:
        return True
    return bool(source.request) and not checked_address("phone's address", phone).is_loopback


Sender = tuple[str, str]
"""Address and subject: two phones may share either."""

MAX_SENDERS = 8
"""Senders kept in memory; of more, those silent for longest are forgotten."""
SILENCE_S = 2.0
"""Silence after which another sender is followed."""
RESTART_S = 1.0
"""A clock set back by more is a source that started anew; by less, a packet that came late."""
PAUSE_S = 2.0
"""Longer gaps are pauses of the source, not lost packets."""
GAP = 1.5
"""Packets farther apart than this many median steps have lost some between them."""
MIN_CLOCK_STEP_S = 1e-4
"""Time between packets by the source's clock below which they are of the same moment."""
# Steps of the source's clock, and arrivals, that are remembered
STEPS = 31
ARRIVALS = 240
RATE_WINDOW_S = 2.0


@dataclass
class Stream:
    """What has arrived from a source. Times are seconds of this machine's clock.

    chosen    sender to follow; None: the first that is heard, until it falls silent
    followed  sender whose packets count now
    senders   all that were heard lately, and when
    has_face  whether the last packet that counted had one
    lost      packets that never came, by the source's clock
    late      packets that came after later ones, or twice
    foreign   datagrams that are none of this source's
    """

    source: Source
    chosen: Sender | None = None
    followed: Sender | None = None
    senders: dict[Sender, float] = field(default_factory=dict)
    has_face: bool = False
    lost: int = 0
    late: int = 0
    foreign: int = 0
    _known: dict[str, Any] = field(default_factory=dict)
    _time: float | None = None
    _steps: deque[float] = field(default_factory=lambda: deque(maxlen=STEPS))
    _arrivals: deque[Any] = field(default_factory=lambda: deque(maxlen=ARRIVALS))

    def receive(self, address: str, data: bytes, now: float) -> FacePacket | None:
        """Take a datagram; its frame, if it is the followed sender's, in order, with a face."""
        decoded = None
        if len(data) <= MAX_DATAGRAM_BYTES:
            decoded = self.source.decode(data, self._known.get(address))
        if decoded is None:
            self.foreign += 1
            return None
        packet, known = decoded
        _remember(self._known, address, known)
        if packet is None:
            return None
        sender = (address, packet.subject)
        _remember(self.senders, sender, now)
        if self.chosen is None and sender != self.followed:  # followed where nobody else is to be
            silent = self.silent_s(now)
            if self.followed is None or silent is None or silent > SILENCE_S:
                self._start(sender)
        if sender != self.followed or not self._is_next(packet.time):
            return None
        self._arrivals.append((now, packet.time))
        self.has_face = packet.weights is not None
        return packet if self.has_face else None

    def follow(self, sender: Sender) -> None:
        """Follow a sender from now on, also while it is silent."""
        self.chosen = sender
        self._start(sender)

    def silent_s(self, now: float) -> float | None:
        """Seconds since the last packet that counted; None before the first."""
        return now - self._arrivals[-1][0] if self._arrivals else None

    def rate(self, now: float) -> float:
        """Packets per second of the last seconds."""
        recent = [arrived for arrived, _ in self._arrivals if now - arrived <= RATE_WINDOW_S]
        span = recent[-1] - recent[0] if len(recent) > 1 else 0.0
        return (len(recent) - 1) / span if span > 0 else 0.0

    def delay_s(self) -> float | None:
        """Seconds that the last packet came later, by the source's clock, than the quickest of the
        last seconds: what the network adds to its shortest time, which cannot be measured from one
        side. None without a clock, where no packet counts as lost, either."""
        offsets = [arrived - time for arrived, time in self._arrivals if time is not None]
        return offsets[-1] - min(offsets) if offsets else None

    def _start(self, sender: Sender) -> None:
        if sender != self.followed:
            self.followed = sender
            self._forget_clock()

    def _forget_clock(self) -> None:
        self._time = None
        self._steps.clear()
        self._arrivals.clear()

    def _is_next(self, time: float | None) -> bool:
        """Whether a packet of the source's `time` is the latest; counts the lost ones."""
        if time is None:
            return True
        before = self._time
        if before is not None and -RESTART_S < time - before < MIN_CLOCK_STEP_S:
            self.late += 1
            return False
        if before is not None and time < before:
            self._forget_clock()
        elif before is not None:
            step = time - before
            steps = step / median(self._steps) if self._steps else 0.0
            if steps > GAP and step < PAUSE_S:
                self.lost += round(steps) - 1
            self._steps.append(step)
        self._time = time
        return True


def _remember(table: dict[Any, Any], key: Any, value: Any) -> None:
    """Store the value as the newest of at most MAX_SENDERS."""
    table.pop(key, None)
    table[key] = value
    if len(table) > MAX_SENDERS:
        del table[next(iter(table))]


RESTING_PACKETS = 15
"""Packets whose mean is the resting face: a quarter of a second."""
MIN_STEP_S = 2 / MAX_FPS
"""Time between rows: a file's times are rounded, and rows at MAX_FPS could be refused."""
MAX_LEAD_S = 5.0
"""Largest time by which a source's clock may be ahead of the packets' arrival: a socket keeps
packets for 4 s while Blender is busy. Beyond it, the clock was set, or belongs to another
source."""


def row_of(*packets: FacePacket) -> Performance:
    """The mean of packets with a face, one at least, as a performance of one row."""
    found = _rows_of(packets, np.zeros(1), DEFAULT_FPS)
    weights, head = (each.mean(0, keepdims=True) for each in (found.weights, found.head))
    return replace(found, weights=weights, head=head)


def _rows_of(packets: Sequence[FacePacket], times: np.ndarray, fps: float) -> Performance:
    heads = [packet.head for packet in packets if packet.head is not None]
    head = np.array(heads) if len(heads) == len(packets) else np.zeros(3)
    return Performance(times, np.array([packet.weights for packet in packets]), head, fps)


def eased(
    before: Performance | None, row: Performance, step_s: float, smoothing_s: float
) -> Performance:
    """The row through a low-pass filter of time constant `smoothing_s` after the one before."""
    if before is None or smoothing_s <= 0:
        return row
    fraction = 1 - np.exp(-step_s / smoothing_s)
    head = before.head + fraction * (row.head - before.head)
    return replace(
        row, weights=before.weights + fraction * (row.weights - before.weights), head=head
    )


@dataclass
class Recording:
    """Packets of a take with their times: steps of the source's clock, or of arrival where it has
    none or jumps.

    start  Blender frame at which it began
    rest   the performer's resting face, which is taken off; None: nothing is
    """

    start: int
    rest: Performance | None
    exchange: tuple[str, ...] = ()
    _times: list[float] = field(default_factory=list)
    _packets: list[FacePacket] = field(default_factory=list)
    _arrived: float = 0.0

    def add(self, packet: FacePacket, now: float) -> None:
        """Take a packet that arrived at `now`, up to as many as a performance may have."""
        time = now
        if self._packets:
            before = self._times[-1]
            last = self._packets[-1]
            step = now - self._arrived
            if packet.time is not None:
                elapsed = -1.0 if last.time is None else packet.time - last.time
                leads = before + elapsed > now + MAX_LEAD_S
                has_jumped = elapsed <= 0 or leads or packet.subject != last.subject
                step = max(step, MIN_STEP_S) if has_jumped else elapsed
            time = before + step
            if step < MIN_STEP_S or len(self._times) >= MAX_ROWS:
                return
        self._arrived = now
        self._times.append(time)
        self._packets.append(packet)

    def __len__(self) -> int:
        return len(self._times)

    def performance(self) -> Performance | None:
        """What was recorded, with the resting face taken off; None for fewer than two rows."""
        if len(self._times) < 2:
            return None
        times = np.array(self._times) - self._times[0]
        raw = _rows_of(self._packets, times, 1 / float(np.median(np.diff(times))))
        return corrected(raw, MotionOptions(exchange=self.exchange), self.rest)
