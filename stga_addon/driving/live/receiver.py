"""The socket of a live source, which is read without waiting."""

import ipaddress
import socket
from contextlib import suppress

from ...errors import StgaError
from .sources import Source

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
