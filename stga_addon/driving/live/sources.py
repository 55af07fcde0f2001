"""The live sources that can be listened to, and their socket, which is read without waiting."""

import ipaddress
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from ...errors import StgaError
from .. import read_performance
from ..performance import FacePacket
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
        _single(read_performance.parse_packet),
        request=read_performance.REQUEST,
        hint="A request is sent to the phone, which answers until it is closed",
    ),
    "vmc": Source(
        "VMC (OSC)",
        39539,
        _decode_vmc,
        hint="The sender must send ARKit's shapes (\"perfect sync\"); VRM's own expressions are left out",
    ),
}


LOOPBACK = "127.0.0.1"
MAX_DATAGRAM_BYTES = 1 << 16
MAX_DATAGRAMS = 256
"""Read at once: more than a usual socket keeps, so that the newest is among them. A flood does not hold Blender up."""
REQUEST_INTERVAL_S = 1.0
"""At which a phone that is silent is asked again."""


class Receiver:
    """An open UDP socket. Close it with `close`."""

    def __init__(self, source: Source, address: str = LOOPBACK, port: int = 0, phone: str = "") -> None:
        """Listen on `address` and `port` (0: the source's usual one) of this machine.

        phone  address of the phone that a source with a request asks for packets
        Raises StgaError where that is no address, or the port cannot be opened.
        """
        self.source, self.port = source, port or source.port
        self.phone = str(checked_address("phone's address", phone)) if source.request else ""
        where = checked_address("address to listen on", address)
        self._asked = float("-inf")
        self._socket = socket.socket(socket.AF_INET6 if where.version == 6 else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.bind((str(where), self.port))
        except OSError as error:
            self._socket.close()
            raise StgaError(
                f"{source.label}: port {self.port} of {where} cannot be opened ({error.strerror or error}); another "
                "program may be listening on it, or this computer has no such address"
            ) from error
        self.port = self._socket.getsockname()[1]

    def read(self) -> list[tuple[str, bytes]]:
        """The sender's address and the bytes of each datagram that is waiting, at most MAX_DATAGRAMS."""
        found: list[tuple[str, bytes]] = []
        while len(found) < MAX_DATAGRAMS:
            try:
                data, sender = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
            except (BlockingIOError, InterruptedError):
                break
            except OSError:  # Windows reports here that a request did not reach the phone
                break
            found.append((sender[0], data))
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
    """Whether listening there, or asking the phone, involves other machines. Raises StgaError as `Receiver` does."""
    if not checked_address("address to listen on", address).is_loopback:
        return True
    return bool(source.request) and not checked_address("phone's address", phone).is_loopback
