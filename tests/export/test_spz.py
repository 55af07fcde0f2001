"""SPZ: read by gsply, by a reader from the specification, rendered as it was."""

import gzip
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from avatar.conftest import random_splats, rendered

from stga_addon.avatar.embedding import to_world
from stga_addon.avatar.file import Avatar
from stga_addon.avatar.splats import Splats
from stga_addon.export.formats import export_avatar
from stga_addon.export.spz import write_spz


def read(path: Path) -> tuple[Splats, int]:
    """Splats and flags of a file of version 3, by Niantic's description."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<4sIIBBBB", data[:16])
    assert (magic, version, reserved) == (b"NGSP", 3, 0)
    rest = (degree + 1) ** 2 - 1
    assert len(data) == 16 + count * (9 + 1 + 3 + 3 + 4 + 3 * rest)
    parts, offset = [], 16
    for width in (9, 1, 3, 3, 4, 3 * rest):
        parts.append(np.frombuffer(data, np.uint8, count * width, offset).reshape(count, width))
        offset += count * width
    position, alpha, color, scale, rotation, sh = parts
    places = np.frombuffer(np.pad(position.reshape(-1, 3), ((0, 0), (1, 0))).tobytes(), "<i4")
    xyz = (places >> 8) / 2**bits
    opacity = np.clip(alpha[:, 0] / 255, 1e-6, 1 - 1e-6)
    base = (color / 255 - 0.5) / 0.15
    higher = (sh.reshape(count, rest, 3) - 128.0) / 128
    splats = Splats(
        xyz=np.array(xyz, np.float32).reshape(count, 3),
        rotation=np.array([quaternion(row) for row in rotation], np.float32).reshape(count, 4),
        log_scale=(scale / 16 - 10).astype(np.float32),
        opacity=np.log(opacity / (1 - opacity)).astype(np.float32),
        sh=np.concatenate([base[:, None], higher], axis=1).astype(np.float32),
        face=np.zeros(count, np.int32),
        unbound=np.zeros(count, bool),
    )
    return splats, flags


def quaternion(row: np.ndarray) -> list[float]:
    """wxyz of four bytes: two bits name the largest; others have sign and nine bits."""
    packed = int.from_bytes(row.tobytes(), "little")
    largest, fields = packed >> 30, [packed >> shift & 1023 for shift in (20, 10, 0)]
    small = [(-1 if field >> 9 else 1) * (field & 511) / 511 / 2**0.5 for field in fields]
    xyzw = [*small[:largest], max(1 - sum(v * v for v in small), 0) ** 0.5, *small[largest:]]
    return [xyzw[3], *xyzw[:3]]


def written(avatar: Avatar, path: Path) -> tuple[Splats, Splats, int]:
    """What is in a file of the avatar, with coefficients of a trained head's magnitude, which the
    format can hold; what was to be in it; and flags."""
    splats = replace(avatar.splats, sh=avatar.splats.sh * np.float32(0.2))
    export_avatar(path, replace(avatar, splats=splats), "spz", [(0, avatar.neutral)])
    found, flags = read(path)
    return found, to_world(splats, avatar.frames(avatar.neutral)), flags


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 3])
def test_reads_back(avatar, tmp_path, degree, antialiased):
    """Catches wrong orders, signs and scales, and a flag of antialiasing that is lost."""
    avatar = replace(avatar, splats=random_splats(4, 300, 30, degree), antialiased=antialiased)
    found, world, flags = written(avatar, tmp_path / "a.spz")
    assert flags == antialiased
    np.testing.assert_allclose(found.xyz, world.xyz, atol=2**-17)
    np.testing.assert_allclose(found.log_scale, world.log_scale, atol=1 / 32 + 1e-6)
    np.testing.assert_allclose(found.opacities(), world.opacities(), atol=1 / 510 + 1e-6)
    np.testing.assert_allclose(found.sh[:, 1:], world.sh[:, 1:], atol=1 / 256 + 1e-6)
    np.testing.assert_allclose(found.sh[:, 0], world.sh[:, 0], atol=1 / 510 / 0.15 + 1e-6)
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
    np.testing.assert_allclose(found.xyz, splats.xyz, rtol=1e-6, atol=0.3)
    assert (found.log_scale == -10).all()
    assert found.sh.min() > 0.9
    np.testing.assert_allclose(np.abs(found.rotation), np.abs(splats.unit_rotations()), atol=2e-3)
    write_spz(tmp_path / "near.spz", splats.rows(np.array([2])))
    np.testing.assert_allclose(read(tmp_path / "near.spz")[0].xyz, splats.xyz[[2]], atol=2**-17)


def test_renders_nearly_equal_and_gsply_reads_it(avatar, tmp_path):
    """Catches an error of quantization that can be seen, and a file that another implementation
    understands otherwise."""
    ours, world, _ = written(avatar, tmp_path / "a.spz")
    assert -10 * np.log10(np.mean((rendered(ours) - rendered(world)) ** 2)) > 40
    gsply = pytest.importorskip("gsply", reason="the package gsply is not installed")
    theirs = gsply.read_spz(tmp_path / "a.spz")
    np.testing.assert_allclose(theirs.means, ours.xyz, atol=1e-5)
    np.testing.assert_allclose(theirs.scales, ours.log_scale, atol=1e-5)
    np.testing.assert_allclose(theirs.quats, ours.rotation, atol=1e-5)
    np.testing.assert_allclose(theirs.sh0, ours.sh[:, 0], atol=1e-5)
    np.testing.assert_allclose(theirs.shN, ours.sh[:, 1:], atol=1e-6)
    np.testing.assert_allclose(theirs.opacities, ours.opacity, atol=1e-3)
