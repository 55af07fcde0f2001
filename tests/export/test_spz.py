"""SPZ: read by gsply, and here."""

import gzip
import struct
import sys
from dataclasses import replace

import gsply
import numpy as np
import pytest
from avatar.conftest import random_splats, world_splats
from numpy.testing import assert_allclose
from refusal import refusal
from scipy.spatial.transform import Rotation

from stga_addon.avatar.embedding import to_world
from stga_addon.export.formats import export_avatar
from stga_addon.export.splat_files import read_splats
from stga_addon.export.spz import write_spz


def read(path):
    """Splats that gsply finds in a file, and its flags, by Niantic's description."""
    found = gsply.read_spz(path)
    sh = found.sh0[:, None]
    sh = sh if found.shN is None else np.concatenate([sh, found.shN], axis=1)
    logit = np.clip(found.opacities, -13, 13).astype(np.float64)
    opacity = 1 / (1 + np.exp(-logit))
    splats = world_splats(found.means, found.quats, found.scales, opacity, sh)
    return splats, gzip.decompress(path.read_bytes())[14]


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 3])
def test_reads_back(avatar, tmp_path, degree, antialiased):
    """Catches wrong orders, signs and scales, also of our reader, and a flag of antialiasing that
    is lost."""
    splats = random_splats(4, 300, 30, degree)
    # of a trained head's magnitude, which the format can hold
    splats = replace(splats, sh=splats.sh * np.float32(0.2))
    avatar = replace(avatar, splats=splats, antialiased=antialiased)
    export_avatar(tmp_path / "a.spz", avatar, "spz", [(0, avatar.neutral)])
    read_by_gsply, flags = read(tmp_path / "a.spz")
    world = to_world(splats, avatar.frames(avatar.neutral))
    assert flags == antialiased
    for found in (read_by_gsply, read_splats(tmp_path / "a.spz", print)):
        assert_allclose(found.xyz, world.xyz, atol=2**-17)
        assert_allclose(found.log_scale, world.log_scale, atol=1 / 32 + 1e-6)
        assert_allclose(found.opacities(), world.opacities(), atol=1 / 510 + 1e-6)
        assert_allclose(found.sh[:, 1:], world.sh[:, 1:], atol=1 / 256 + 1e-6)
        assert_allclose(found.sh[:, 0], world.sh[:, 0], atol=1 / 510 / 0.15 + 1e-6)
        aligned = np.abs((found.unit_rotations() * world.unit_rotations()).sum(axis=1))
        assert np.degrees(2 * np.arccos(np.minimum(aligned, 1))).max() < 0.3


def test_far_and_extreme_splats(tmp_path):
    """Catches coordinates, scales and colors that wrap around where they do not fit."""
    splats = random_splats(5, 4, 1, 1)
    splats = replace(
        splats,
        xyz=np.array([[-1000, 0, 0], [1000, 0, 0], [0, 127.99, 0], [0, 0, 1e6]], np.float32),
        log_scale=np.full((4, 3), -30, np.float32),
        opacity=np.array([-100, 100, 0, 0], np.float32),
        sh=np.full((4, 4, 3), 50, np.float32),
        rotation=np.array([[0, 0, 0, 0], [-1, 0, 0, 0], [1, 1, 1, 1], [0, 0, -2, 2]], np.float32),
    )
    write_spz(tmp_path / "far.spz", splats)
    found, _ = read(tmp_path / "far.spz")
    assert_allclose(found.xyz, splats.xyz, rtol=1e-6, atol=0.3)
    assert (found.log_scale == -10).all()
    assert found.sh.min() > 0.9
    assert_allclose(np.abs(found.rotation), np.abs(splats.unit_rotations()), atol=2e-3)
    write_spz(tmp_path / "near.spz", splats.rows(np.array([2])))
    assert_allclose(read(tmp_path / "near.spz")[0].xyz, splats.xyz[[2]], atol=2**-17)


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("xyz", np.nan, "xyz holds a value that is not finite"),
        ("opacity", np.inf, "opacity holds a value that is not finite"),
        ("log_scale", -np.inf, "log_scale holds a value that is not finite"),
        ("rotation", np.nan, "rotation holds a value that is not finite"),
        ("sh", np.inf, "sh holds a value that is not finite"),
        ("log_scale", 6.0, "standard deviations to 379, but a splat has one of e\\^6"),
        ("xyz", 1e7, "positions from -8388607 to 8388607, but a splat is at 1e\\+07"),
    ],
)
def test_values_that_spz_cannot_hold(tmp_path, field, value, sentence):
    """Catches a traceback, half a file, and far splats moved to another place in silence."""
    splats = random_splats(5, 4, 1, 1)
    array = getattr(splats, field).copy()
    array[-1] = value
    with refusal(f"a.spz: .*{sentence}"):
        write_spz(tmp_path / "a.spz", replace(splats, **{field: array}))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("version", [1, 2])
def test_rotations_of_older_versions(tmp_path, version):
    """Catches a wrong scale, zero, order or sign of the three bytes of a rotation, as gsply and
    SciPy have them."""
    count = 200
    turns = Rotation.random(count, random_state=version)
    xyz = np.rint((turns.as_quat(canonical=True)[:, :3] + 1) * 127.5).astype(np.uint8)
    for each in {version, 2}:  # gsply takes the places of version 1 for those of 2
        header = struct.pack("<4sIIBBBB", b"NGSP", each, count, 0, 12, 0, 0)
        others = bytes(count * ((6 if each == 1 else 9) + 1 + 3 + 3))
        (tmp_path / f"{each}.spz").write_bytes(gzip.compress(header + others + xyz.tobytes()))
    found = read_splats(tmp_path / f"{version}.spz").rotation
    assert_allclose(found, gsply.read_spz(tmp_path / "2.spz").quats, atol=5e-5)
    off = Rotation.from_quat(found, scalar_first=True) * turns.inv()
    assert np.degrees(np.median(off.magnitude())) < 0.8


@pytest.mark.parametrize("degree", [0, 2])
def test_version_4(tmp_path, monkeypatch, degree):
    """Catches SuperSplat's default refused, streams in another order, and a traceback without the
    library. gsply writes and reads it."""
    pytest.importorskip("zstandard")
    write_spz(tmp_path / "3.spz", random_splats(6, 50, 5, degree))
    path = tmp_path / "4.spz"
    gsply.write_spz(path, gsply.read_spz(tmp_path / "3.spz"), version=4, fractional_bits=16)
    found = read_splats(path, print)
    same = gsply.read_spz(path)
    assert_allclose(found.xyz, same.means, atol=1e-6)
    assert_allclose(found.log_scale, same.scales, atol=1e-6)
    assert_allclose(found.sh[:, 0], same.sh0, atol=1e-6)
    assert found.sh.shape[1] == (degree + 1) ** 2
    path.write_bytes(path.read_bytes()[:-9])
    with refusal("4.spz: is not a readable SPZ file"):
        read_splats(path)
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with refusal("4.spz: is SPZ of version 4, which needs the package zstandard"):
        read_splats(path)


def test_extensions(tmp_path):
    """Catches a file refused for what a viewer keeps behind the splats."""
    path = tmp_path / "a.spz"
    write_spz(path, random_splats(6, 20, 5, 1))
    expected = read_splats(path)
    data = bytearray(gzip.decompress(path.read_bytes()))
    data[14] |= 2
    path.write_bytes(gzip.compress(bytes(data) + b"\x01\x00\x00\xad\x04\x00\x00\x00????"))
    said = []
    assert_allclose(read_splats(path, said.append).xyz, expected.xyz)
    assert said == [f"{path}: has extensions, which are not read"]
