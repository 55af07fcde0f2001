"""The live sources that can be listened to."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from .. import facial_mocap
from ..packet import FacePacket
from . import live_link_face, vmc

Decoded = tuple[FacePacket | None, Any]
"""The frame that a datagram completes, if any, and what is known of its sender from then on."""


@dataclass(frozen=True)
class Source:
    """A protocol on UDP.

    port     usual port
    decode   datagram and what is known of its sender (None at first) -> `Decoded`; None for bytes of another kind
    request  what is sent to the phone to make it send, on the same port; b"" for sources that send by themselves
    hint     what a user has to know
    """

    label: str
    port: int
    decode: Callable[[bytes, Any], Decoded | None]
    request: bytes = b""
    hint: str = ""


def _single(decode: Callable[[bytes], FacePacket | None]) -> Callable[[bytes, Any], Decoded | None]:
    """A decoder of datagrams that are frames by themselves."""

    def decoded(data: bytes, _: Any) -> Decoded | None:
        packet = decode(data)
        return None if packet is None else (packet, None)

    return decoded


def _decode_vmc(data: bytes, known: Any) -> Decoded | None:
    return vmc.decode(data, known or vmc.Received())


SOURCES = {
    "live_link_face": Source(
        "Live Link Face",
        11111,
        _single(live_link_face.decode),
        hint="Choose the mode Live Link (ARKit) in the app; its MetaHuman Animator mode sends no such weights",
    ),
    "facial_mocap": Source(
        "iFacialMocap",
        49983,
        _single(facial_mocap.parse_packet),
        request=facial_mocap.REQUEST,
        hint="A request is sent to the phone, which answers until it is closed",
    ),
    "vmc": Source(
        "VMC (OSC)",
        39539,
        _decode_vmc,
        hint="The sender must send ARKit's shapes (\"perfect sync\"); VRM's own expressions are left out",
    ),
}
