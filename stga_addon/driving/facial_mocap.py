"""iFacialMocap's text packets: named weights in percent, rotations of head and eyes in degrees."""

import math
import re

import numpy as np

from .names import COLUMN, COUNT, MAX_WEIGHT, arkit_name
from .packet import FacePacket

REQUEST = b"iFacialMocap_sahuasouryya9218sauhuiayeta91555dy3719"
"""Makes the app send to the address that this comes from."""
MAX_PACKET_BYTES = 1 << 16
_VALUE = re.compile(r"([A-Za-z_]+)[-&](-?\d+(?:\.\d+)?)", re.ASCII)


def parse_packet(data: bytes) -> FacePacket | None:
    """The frame of `mouthSmile_R-0|…|=head#rx,ry,rz,x,y,z|rightEye#x,y,z|leftEye#x,y,z|`, or None for other bytes.

    Version 2 separates names and values by `&`. Source: the protocol's description by its author.
    """
    if len(data) > MAX_PACKET_BYTES:
        return None
    try:
        text = data.decode("ascii")
    except UnicodeDecodeError:
        return None
    weights, names, head = np.zeros(COUNT), [], None
    for field in text.strip().split("|"):
        value = _VALUE.fullmatch(field)
        if value is not None:
            name = arkit_name(value[1])
            if name is not None:
                weights[COLUMN[name]] = float(value[2]) / 100
                names.append(name)
        elif field.lstrip("=").startswith("head#"):
            head = _head(field.partition("#")[2])
    if not names or not (np.abs(weights) <= MAX_WEIGHT).all():
        return None
    return FacePacket(tuple(names), weights, head)


def _head(text: str) -> tuple[float, float, float] | None:
    """Yaw, pitch and roll in radians of `rx,ry,rz,…` in degrees."""
    try:
        pitch, yaw, roll = (math.radians(float(part)) for part in text.split(",")[:3])
    except ValueError:
        return None
    return (yaw, pitch, roll) if all(map(math.isfinite, (yaw, pitch, roll))) else None
