"""Which packets of a source count, and what is said about them."""

import socket
import struct

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusal import refusal

from stga_addon.driving.inverse import write_performance
from stga_addon.driving.live.sources import (
    SOURCES,
    Receiver,
    Recording,
    Stream,
    eased,
    leaves_this_machine,
    row_of,
)
from stga_addon.driving.performance import COLUMN
from stga_addon.driving.performers import read_performance

from . import wire
from .test_decoders import APPLY, blend, bundle, osc_text

LINK = SOURCES["live_link_face"]


def jaw(frame, value, **options):
    return wire.live_link_face({"jawOpen": value}, frame, **options)


class Watched(Stream):
    """Notes what a head that follows it shows."""

    shown = 0.0

    def receive(self, *arguments):
        packet = super().receive(*arguments)
        if packet is not None:
            self.shown = float(packet.weights[COLUMN["jawOpen"]])
        return packet


def test_late_doubled_and_lost_packets_and_a_clock_that_starts_anew():
    """Catches a head that jumps back or stands still after midnight, and wrong counts of losses."""
    stream = Watched(LINK)
    order = [0, 2, 4, 8, 6, 8, 10, 16]
    for number, frame in enumerate(order):
        stream.receive("10.0.0.5", jaw(frame, frame / 100), number / 30)
        assert stream.shown == pytest.approx(max(order[: number + 1]) / 100)
    assert (stream.lost, stream.late, stream.foreign) == (3, 2, 0)  # 6 came, but too late
    stream.receive("10.0.0.5", b"hello", 1.0)
    assert stream.foreign == 1
    assert stream.receive("10.0.0.5", jaw(0, 0.9), 2.0) is None  # a third of a second back: late
    assert (Watched(LINK).rate(0.0), Watched(LINK).delay_s()) == (0, None)
    # after midnight, or after the app was started again
    stream = Watched(LINK)
    day = 24 * 3600 * 60
    for number, frame in enumerate([day - 2, day - 1, 0, 1]):
        stream.receive("a", jaw(frame, frame % 1000 / 1000), number / 60)
    assert stream.shown == pytest.approx(0.001)
    assert stream.lost == 0


def test_a_face_that_leaves_the_picture():
    """Catches a face that falls to zero, or counts as silence, while it is out of the picture."""
    stream = Watched(LINK)
    stream.receive("a", jaw(0, 0.5), 0.0)
    assert stream.has_face
    assert stream.receive("a", jaw(1, 0.0, count=0), 1 / 60) is None
    assert not stream.has_face
    assert stream.shown == 0.5
    assert stream.silent_s(1 / 60) == 0
    stream.receive("a", jaw(2, 0.7), 2 / 60)
    assert stream.has_face


def test_two_phones_on_one_port():
    """Catches a head that trembles between two faces, cannot be handed over, or waits for ever."""
    stream = Watched(LINK)
    for frame in range(60):
        stream.receive("10.0.0.5", jaw(frame, 0.1, subject="A"), frame / 60)
        stream.receive("10.0.0.6", jaw(frame + 5000, 0.9, subject="B"), frame / 60)
        assert stream.shown == pytest.approx(0.1)
    assert set(stream.senders) == {("10.0.0.5", "A"), ("10.0.0.6", "B")}
    stream.receive("10.0.0.6", jaw(5100, 0.9, subject="B"), 10.0)  # A is silent
    assert stream.shown == pytest.approx(0.9)
    stream.follow(("10.0.0.5", "A"))
    stream.receive("10.0.0.6", jaw(5200, 0.8, subject="B"), 20.0)
    assert stream.shown == pytest.approx(0.9)
    stream.receive("10.0.0.5", jaw(61, 0.2, subject="A"), 20.0)
    assert stream.shown == pytest.approx(0.2)


def test_rate_and_delay():
    """Catches a rate not of the last seconds, and a delay of the clocks' difference."""
    stream = Watched(LINK)
    for frame in range(300):
        late = 0.05 if frame == 299 else 0.0
        stream.receive("a", jaw(1_000_000 + frame, 0.5), frame / 60 + late)
    assert stream.rate(5.0) == pytest.approx(60, rel=0.03)
    assert stream.delay_s() == pytest.approx(0.05, abs=1e-3)


def test_on_loopback(monkeypatch):
    """Catches a socket that waits, listens elsewhere, or holds Blender up while it is flooded."""
    monkeypatch.setattr("stga_addon.driving.live.sources.MAX_DATAGRAMS", 50)
    receiver = Receiver(LINK, port=wire.free_port())
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    assert receiver.read() == []
    sent = jaw(1, 0.5)
    for _ in range(60):
        sender.sendto(sent, ("127.0.0.1", receiver.port))
    assert receiver.read() == [("127.0.0.1", sent)] * 50
    assert receiver._socket.getsockname()[0] == "127.0.0.1"
    with refusal(f"port {receiver.port} of 127.0.0.1 cannot be opened"):
        Receiver(LINK, port=receiver.port)
    receiver.close()
    sender.close()


@pytest.mark.parametrize("times", [(5e-324, 1e-300, 1), (1e-30, 2e-5, 1.5), (-1e29, 1e29, 1e29)])
def test_absurd_times(times):
    """Catches Drive Live that ends with an OverflowError, or has lost more packets than there
    are."""
    stream = Watched(SOURCES["vmc"])
    for time in (0.0, *times):
        clock = osc_text("/VMC/Ext/T") + osc_text(",d") + struct.pack(">d", time)
        stream.receive("a", bundle(clock, blend("jawOpen", 0.5), APPLY), 0.0)
    assert stream.shown == 0.5
    assert stream.lost < 20_000
    stream = Watched(LINK)
    for frame, part, rate in ((0, 0.0, 60), (0, 1e-45, 2**31 - 1), (60, 0.0, 60)):
        data = bytearray(jaw(frame, 0.5, rate=rate))
        at = len(data) - 4 * 61 - 1 - 12
        data[at : at + 4] = struct.pack(">f", part)
        stream.receive("a", bytes(data), 0.0)
    assert stream.lost < 20_000


@pytest.mark.parametrize("source", ["vmc", "facial_mocap"])
def test_a_flood_of_large_datagrams(source):
    """Catches a timer that stands still while datagrams of 64 kB are decoded, those that fit too,
    and a phone's next packet that waits behind them."""
    receiver = Receiver(SOURCES[source], port=wire.free_port(), phone="127.0.0.1")
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one = bundle(*[blend("jawOpen", 0.5)] * 330, APPLY)
    fitting = one if source == "vmc" else b"|".join([b"jawOpen-50"] * 1400)
    for data in (fitting * 4, fitting):
        stream = Watched(SOURCES[source])
        for _ in range(8):
            sender.sendto(data[:65_000], ("127.0.0.1", receiver.port))
        read = []
        while found := receiver.read():
            read.append(found)
            for address, received in found:
                stream.receive(address, received, 0.0)
        decoded = [sum(len(data) for _, data in f if len(data) <= 1 << 14) for f in read]
        assert max(decoded) <= 3 << 14
        assert sum(map(len, read)) >= 3
        assert stream.shown == (0.0 if len(data) > 1 << 14 else 0.5)
        assert (stream.foreign > 0) == (len(data) > 1 << 14)
    receiver.close()
    sender.close()


def test_the_request_to_a_phone():
    """Catches iFacialMocap that is never asked, or is asked for ever faster."""
    phone = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    phone.bind(("127.0.0.2", SOURCES["facial_mocap"].port))
    phone.settimeout(5)
    receiver = Receiver(SOURCES["facial_mocap"], port=wire.free_port(), phone="127.0.0.2")
    for now in (0.0, 0.5, 1.1):
        receiver.ask(now)
    data, address = phone.recvfrom(100)
    assert data == b"iFacialMocap_sahuasouryya9218sauhuiayeta91555dy3719"
    phone.recvfrom(100)
    phone.setblocking(False)
    with pytest.raises(BlockingIOError):
        phone.recvfrom(100)
    phone.sendto(wire.facial_mocap({"jawOpen": 0.5}), address)
    ((_, reply),) = receiver.read()
    stream = Watched(SOURCES["facial_mocap"])
    stream.receive("a", reply, 0.0)
    assert stream.shown == 0.5
    receiver.close()
    phone.close()


def test_addresses():
    """Catches packets that leave the computer without the user's word, and a mistyped address."""
    assert not leaves_this_machine(LINK, "127.0.0.1", "no matter")
    assert leaves_this_machine(LINK, "0.0.0.0", "")
    assert leaves_this_machine(SOURCES["facial_mocap"], "127.0.0.1", "192.168.0.7")
    with refusal("phone's address: '' is no IP address"):
        leaves_this_machine(SOURCES["facial_mocap"], "127.0.0.1", "")
    with refusal("address to listen on: 'localhost' is no IP address"):
        Receiver(LINK, "localhost")
    with refusal("cannot be opened"):
        Receiver(LINK, "203.0.113.1")


def test_recording():
    """Catches arrival times, a resting face that is not taken off, and sides exchanged twice."""
    stream = Watched(LINK)
    data = wire.live_link_face({"jawOpen": 0.2, "mouthLeft": 0.3}, 0, (0.1, 0, 0))
    first = stream.receive("a", data, 0.0)
    recording = Recording(7, row_of(first), ("mouth",))
    for frame in (0, 1, 2, 5):
        data = wire.live_link_face({"jawOpen": 1.0, "mouthLeft": 0.5}, 100 + frame, (0.4, 0, 0))
        recording.add(stream.receive("a", data, 3.0 * frame), 3.0 * frame)
    take = recording.performance()
    assert_allclose(take.times, np.array([0, 1, 2, 5]) / 60, atol=1e-6)
    assert take.lost == 2
    assert_allclose(take.weights[:, COLUMN["jawOpen"]], 1.0, atol=1e-6)
    assert_allclose(take.weights[:, COLUMN["mouthRight"]], (0.5 - 0.3) / 0.7, atol=1e-6)
    assert_allclose(take.weights[:, COLUMN["mouthLeft"]], 0)
    assert_allclose(take.head[:, 0], 0.3, atol=1e-6)
    assert Recording(0, None).performance() is None


@pytest.mark.parametrize("jump", ["app restarted", "midnight", "another sender", "clock forward"])
def test_a_recording_goes_on_where_the_clock_jumps(jump, tmp_path):
    """Catches packets that are left out, a take as long as two clocks are apart, and a CSV that
    cannot be read back. Packets arrive two at once, and those around the jump while Blender is
    busy."""
    stream = Watched(LINK)
    recording = Recording(1, None)
    day = 24 * 3600 * 60
    change = {"app restarted": -500_000, "midnight": -day}.get(jump, 79_001 * 60)
    for number in range(60):
        subject = "B" if jump == "another sender" and number >= 30 else "A"
        stream.follow(("a", subject))
        frame = day - 30 + number + (change if number >= 30 else 0)
        data = jaw(frame, number / 100, subject=subject)
        now = 1000 + (40 if 20 < number < 40 else number | 1) / 60
        recording.add(stream.receive("a", data, now), now)
    write_performance(tmp_path / "take.csv", recording.performance())
    take = read_performance(tmp_path / "take.csv")
    assert_allclose(take.weights[:, COLUMN["jawOpen"]], np.arange(60) / 100, atol=1e-6)
    assert_allclose(take.times, np.arange(60) / 60, atol=1 / 60)
    assert take.fps == pytest.approx(60, rel=1e-3)


@pytest.mark.parametrize("sent", ["every frame", "once"])
def test_vmc_whose_clock_stands_still(sent):
    """Catches a head that freezes with the sender's clock, and a take of one packet."""
    stream = Watched(SOURCES["vmc"])
    recording = Recording(1, None)
    clock = osc_text("/VMC/Ext/T") + osc_text(",f") + struct.pack(">f", 12.5)
    for number in range(60):
        time = [clock] if sent == "every frame" or number == 0 else []
        data = bundle(*time, blend("jawOpen", number / 100), APPLY)
        packet = stream.receive("a", data, number / 60)
        assert stream.shown == pytest.approx(number / 100)
        recording.add(packet, number / 60)
    assert_allclose(recording.performance().times, np.arange(60) / 60, atol=1e-6)


def test_smoothing():
    """Catches a filter that depends on the packets' rate: after its time constant 63 % are done."""
    stream = Watched(LINK)
    low, high = (row_of(stream.receive("a", jaw(frame, frame), 0.0)) for frame in (0, 1))
    for rate in (30, 120):
        row = low
        for _ in range(rate // 10):
            row = eased(row, high, 1 / rate, 0.1)
        assert row.weights[0, COLUMN["jawOpen"]] == pytest.approx(1 - np.exp(-1), abs=1e-3)
