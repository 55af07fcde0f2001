"""SPZ: read by gsply, and here."""

import gzip
from dataclasses import replace

import gsply
import numpy as np
import pytest
from avatar.conftest import random_splats, world_splats
from numpy.testing import assert_allclose

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
