"""Packets written by hand from the layouts of the protocols."""

import re
import socket
import struct

import numpy as np

from stga_addon.driving.performance import ARKIT_SHAPES

UDP_ORDER = list(ARKIT_SHAPES)
for pair in ("jaw", "mouth"):
    left = UDP_ORDER.index(f"{pair}Left")
    right = UDP_ORDER.index(f"{pair}Right")
    UDP_ORDER[left], UDP_ORDER[right] = UDP_ORDER[right], UDP_ORDER[left]


def live_link_face(
    weights,
    frame=0,
    head=(0.0, 0.0, 0.0),
    subject="phone",
    device="DEVICE-1",
    count=61,
    rate=60,
):
    """Version, device and subject, frame and rate, the values; big-endian."""
    values = [weights.get(name, 0.0) for name in UDP_ORDER] + [*head] + [0.0] * 6
    texts = device.encode(), subject.encode()
    names = b"".join(struct.pack(">i", len(text)) + text for text in texts)
    time = struct.pack(">ifii", frame, 0.25, rate, 1)
    body = struct.pack(f">B{count}f", count, *values[:count]) if count else b""
    return b"\x06" + names + time + body


def facial_mocap(weights, head=(0, 0, 0), separator="-"):
    """Percent; pitch, yaw and roll in degrees, and a position."""
    spelled = [re.sub("(Left|Right)$", lambda side: f"_{side[0][0]}", n) for n in ARKIT_SHAPES]
    percent = [round(100 * weights.get(name, 0.0)) for name in ARKIT_SHAPES]
    fields = [f"{n}{separator}{value}" for n, value in zip(spelled, percent, strict=True)]
    angles = ",".join(f"{value}" for value in head)
    rest = f"|=head#{angles},0.1,0.2,-0.3|rightEye#1,2,0|leftEye#1,2,0|"
    return ("|".join(fields) + rest).encode()


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def mixed(seed):
    """A weight per shape that tells the shapes apart."""
    values = np.random.default_rng(seed).random(len(ARKIT_SHAPES)).astype(np.float32)
    return dict(zip(ARKIT_SHAPES, values.tolist(), strict=True))
