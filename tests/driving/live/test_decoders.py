"""Decoders of live sources, against bytes from the layouts and independent encoders."""

import math
import struct

import numpy as np
import pytest

from stga_addon.driving import performance_files
from stga_addon.driving.head_map import head_turns
from stga_addon.driving.live import decoders
from stga_addon.driving.live.decoders import Received, decode_live_link_face, decode_vmc
from stga_addon.driving.performance import ARKIT_SHAPES, COLUMN

from . import wire


def as_dict(weights):
    return dict(zip(ARKIT_SHAPES, weights.tolist(), strict=True))


def test_live_link_face():
    """Catches values by the CSV's columns, times or angles of another kind, other counts
    refused, and no face taken for a resting one."""
    weights = wire.mixed(0)
    packet = decode_live_link_face(wire.live_link_face(weights, 120, (0.1, -0.2, 0.3), "Änne"))
    assert as_dict(packet.weights) == pytest.approx(weights)
    assert packet.head == pytest.approx((0.1, -0.2, 0.3))
    assert packet.subject == "Änne"
    assert packet.time == pytest.approx(120.25 / 60)
    weights = wire.mixed(1)
    packet = decode_live_link_face(wire.live_link_face(weights, count=51))
    assert as_dict(packet.weights) == pytest.approx({**weights, "tongueOut": 0.0})
    assert packet.head is None
    assert "tongueOut" not in packet.names
    packet = decode_live_link_face(wire.live_link_face(weights, count=52))
    assert as_dict(packet.weights) == pytest.approx(weights)
    for absent in (wire.live_link_face({}, count=0), wire.live_link_face({}, count=0) + b"\0"):
        packet = decode_live_link_face(absent)
        assert packet.weights is None
    assert decode_live_link_face(wire.live_link_face({}, count=30)) is None


def test_packets_of_pylivelinkface():
    """Catches that library's little-endian header misread: version, '$', then the first length."""
    device = "$" + "12345678-1234-1234-1234-123456789abc"
    name = b"Python_LiveLinkFace"
    values = np.linspace(0, 1, 61)
    data = struct.pack("<I", 6) + device.encode() + struct.pack("!i", len(name)) + name
    data += struct.pack("!IIIIB61f", 600, 1056060032, 60, 1, 61, *values)
    packet = decode_live_link_face(data)
    assert packet.subject == name.decode()
    assert packet.time == pytest.approx((600 + 0.47295) / 60, abs=1e-5)
    assert as_dict(packet.weights)["jawLeft"] == pytest.approx(values[15])


def test_facial_mocap():
    """Catches percent, degrees or pitch misread, and the second version's separator."""
    weights = {name: round(value, 2) for name, value in wire.mixed(2).items()}
    for separator in "-&":
        packet = performance_files.parse_packet(wire.facial_mocap(weights, (10, 20, 30), separator))
        assert as_dict(packet.weights) == pytest.approx(weights)
        assert packet.head == pytest.approx(np.radians([20, 10, 30]))
    packet = performance_files.parse_packet(b"mouthSmile_L&-5|jawOpen&12|")
    assert packet.weights[COLUMN["mouthSmileLeft"]] == pytest.approx(-0.05)


def osc_text(text):
    return text.encode() + b"\0" * (4 - len(text.encode()) % 4)


def blend(name, value):
    return b"".join(map(osc_text, ("/VMC/Ext/Blend/Val", ",sf", name))) + struct.pack(">f", value)


APPLY = osc_text("/VMC/Ext/Blend/Apply") + osc_text(",")


def bundle(*messages):
    parts = b"".join(struct.pack(">i", len(message)) + message for message in messages)
    return osc_text("#bundle") + struct.pack(">Q", 1) + parts


def test_vmc_by_hand():
    """Catches values used before they are applied, forgotten between datagrams, or VRM's own."""
    packet, known = decode_vmc(bundle(blend("JawOpen", 0.5), blend("A", 1.0)), Received())
    assert packet is None
    inner = bundle(blend("cheekPuff", 0.75), APPLY)
    packet, known = decode_vmc(bundle(blend("MouthSmile_L", 0.25), inner), known)
    expected = {"jawOpen": 0.5, "mouthSmileLeft": 0.25, "cheekPuff": 0.75}
    assert {name: value for name, value in as_dict(packet.weights).items() if value} == expected
    assert set(packet.names) == set(expected)
    packet, _ = decode_vmc(bundle(blend("jawOpen", 0.0), APPLY), known)
    assert as_dict(packet.weights)["cheekPuff"] == 0.75
    other = osc_text("/avatar/x") + osc_text(",f") + struct.pack(">f", 1)
    assert decode_vmc(other, Received()) is None


def test_vmc_with_python_osc():
    """Catches what bytes by hand and decoder get wrong together."""
    message = pytest.importorskip("pythonosc.osc_message_builder")
    bundles = pytest.importorskip("pythonosc.osc_bundle_builder")
    weights = wire.mixed(3)
    known = Received()

    def written(address, *values):
        builder = message.OscMessageBuilder(address)
        for value in values:
            builder.add_arg(value)
        return builder.build()

    builder = bundles.OscBundleBuilder(bundles.IMMEDIATELY)
    builder.add_content(written("/VMC/Ext/T", 12.5))
    for name, value in weights.items():
        builder.add_content(written("/VMC/Ext/Blend/Val", name[0].upper() + name[1:], value))
    builder.add_content(written("/VMC/Ext/Blend/Apply"))
    packet, known = decode_vmc(builder.build().dgram, known)
    assert as_dict(packet.weights) == pytest.approx(weights)
    assert packet.time == 12.5
    mixed = written("/x/y", 1, 2.5, "text", b"blob", True, False)
    expected = [("/x/y", (1, 2.5, "text", b"blob", True, False))]
    assert list(decoders.osc_messages(mixed.dgram)) == expected


@pytest.mark.parametrize("axis", range(3))
def test_vmc_head(axis):
    """Catches Unity's left-handed axes: about x a turn is alike, about y and z the other way."""
    angle = 0.3
    quaternion = np.array([0.0, 0.0, 0.0, math.cos(angle / 2)])
    quaternion[axis] = math.sin(angle / 2)
    where = b"".join(map(osc_text, ("/VMC/Ext/Bone/Pos", ",sfffffff", "Head")))
    where += struct.pack(">7f", 0, 1, 0, *quaternion)
    packet, _ = decode_vmc(bundle(where, blend("jawOpen", 0), APPLY), Received())
    turn = head_turns(np.array([packet.head]))[0]
    expected = np.zeros(3)
    expected[axis] = angle if axis == 0 else -angle
    np.testing.assert_allclose(turn, expected, atol=1e-6)


def malformed(rng):
    """A valid packet that is cut off, lengthened, or has bytes exchanged; or noise."""
    valid = [
        wire.live_link_face(wire.mixed(0)),
        wire.facial_mocap(wire.mixed(0)),
        bundle(blend("jawOpen", 0.5), bundle(blend("A", 1.0), APPLY)),
    ]
    data = bytearray(valid[rng.integers(3)])
    for _ in range(rng.integers(4)):
        data[rng.integers(len(data))] = rng.integers(256)
    cut = bytes(data[: rng.integers(len(data))])
    noise = rng.bytes(rng.integers(1, 400))
    start = (b"", b"\x06", b"#bundle\0")[rng.integers(3)]
    return (cut, bytes(data) + noise, bytes(data), start + noise)[rng.integers(4)]


def test_ten_thousand_malformed_packets():
    """Catches an exception of any decoder, and weights or angles that are not finite."""
    rng = np.random.default_rng(0)
    known = Received()
    for _ in range(10_000):
        data = malformed(rng)
        vmc, known = decode_vmc(data, known) or (None, known)
        for packet in decode_live_link_face(data), performance_files.parse_packet(data), vmc:
            if packet is not None and packet.weights is not None:
                assert np.isfinite(packet.weights).all()
                assert packet.time is None or math.isfinite(packet.time)
                assert packet.head is None or np.isfinite(packet.head).all()
