"""Corrected rows of a live source, and a recording of them."""

from dataclasses import dataclass, field, replace

import numpy as np

from ..open_motion import MotionOptions, corrected
from ..packet import FacePacket
from ..performance import Performance
from ..read_performance import DEFAULT_FPS, MAX_FPS, MAX_ROWS

RESTING_PACKETS = 15
"""Whose mean is the resting face: a quarter of a second."""
MIN_STEP_S = 2 / MAX_FPS
"""Between rows: a file's times are rounded, and rows at MAX_FPS could be refused."""
MAX_LEAD_S = 5.0
"""By which a source's clock may be ahead of the packets' arrival: a usual socket keeps packets for 4 s while Blender is
busy. Beyond it, the clock was set, or is another's."""


def row_of(packet: FacePacket) -> Performance:
    """A packet with a face as a performance of one row."""
    assert packet.weights is not None
    head = None if packet.head is None else np.array([packet.head])
    return Performance(np.zeros(1), packet.weights[None], head, DEFAULT_FPS)


def resting(packets: list[FacePacket]) -> Performance:
    """The mean of packets with a face, one at least, as one row."""
    rows = [row_of(packet) for packet in packets]
    heads = [row.head for row in rows if row.head is not None]
    weights = np.mean([row.weights for row in rows], axis=0)
    return replace(rows[-1], weights=weights, head=np.mean(heads, axis=0) if len(heads) == len(rows) else None)


def eased(before: Performance | None, row: Performance, step_s: float, smoothing_s: float) -> Performance:
    """The row, drawn towards the one before it: a low-pass filter of time constant `smoothing_s`."""
    if before is None or smoothing_s <= 0:
        return row
    share = 1 - np.exp(-step_s / smoothing_s)
    head = row.head
    if head is not None and before.head is not None:
        head = before.head + share * (head - before.head)
    return replace(row, weights=before.weights + share * (row.weights - before.weights), head=head)


@dataclass
class Recording:
    """Packets of a take with their times: steps of the source's clock, or of arrival where it has none or jumps.

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
        """Take a packet that arrived at `now`; of more than a performance may have, the rest are left out."""
        time = now
        if self._packets:
            before, last, step = self._times[-1], self._packets[-1], now - self._arrived
            if packet.time is not None:
                own = -1.0 if last.time is None else packet.time - last.time
                has_jumped = own <= 0 or before + own > now + MAX_LEAD_S or packet.subject != last.subject
                step = max(step, MIN_STEP_S) if has_jumped else own
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
        rows = [row_of(packet) for packet in self._packets]
        heads = [row.head for row in rows if row.head is not None]
        times = np.array(self._times) - self._times[0]
        raw = Performance(
            times,
            np.concatenate([row.weights for row in rows]),
            np.concatenate(heads) if len(heads) == len(rows) else None,
            1 / float(np.median(np.diff(times))),
        )
        return corrected(raw, MotionOptions(exchange=self.exchange), self.rest)
