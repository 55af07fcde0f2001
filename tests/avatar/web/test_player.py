"""The player's numerics in Node against numpy: pose, frames, strain, order, and damaged files."""

import gzip
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stga_addon.avatar.playback import Playback
from stga_addon.avatar.web.data_file import data_file
from stga_addon.avatar.web.page import PLAYER
from stga_addon.avatar.web.rig import baked_rig

from .conftest import make_head


def evaluated(data: bytes, folder: Path) -> dict[str, Any]:
    """What evaluate.mjs makes of a data file."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("no Node.js on this machine")
    (folder / "a.stga").write_bytes(data)
    script = Path(__file__).with_name("evaluate.mjs")
    done = subprocess.run([node, str(script), str(PLAYER), str(folder / "a.stga")], capture_output=True, timeout=120)
    assert not done.stderr, done.stderr.decode()
    return dict(json.loads(done.stdout))


@pytest.mark.parametrize("baked", [False, True])
def test_pose_is_flames(head, baked, tmp_path):
    """Catches a joint, corrective, offset or rotation of the player that is not FLAME's."""
    rig = baked_rig(list(head.meshes)) if baked else head.rig
    results = evaluated(head.data(rig, exact=True), tmp_path)["results"]
    for mesh, result in zip(head.meshes, results, strict=True):
        assert np.abs(np.reshape(result["vertices"], (-1, 3)) - mesh).max() < 6e-6


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_frames_and_strain_are_the_embedding(convention, tmp_path):
    """Catches another axis, scale, sliver rule or strain than the one that the splats were trained with."""
    head = make_head(convention)
    results = evaluated(head.data(exact=True), tmp_path)["results"]
    for mesh, result in zip(head.meshes, results, strict=True):
        expected = head.avatar.frames(mesh)
        found = np.reshape(result["frames"], (-1, 3, 4))
        scale = np.abs(expected.rotation * expected.scale[:, None, None]).max()
        # The mesh is that of float32 blend shapes: a thin triangle's axes turn with the last digit.
        error = np.abs(found[..., :3] - expected.rotation * expected.scale[:, None, None]).max((1, 2)) / scale
        assert np.quantile(error, 0.99) < 1e-3
        assert np.abs(found[..., 3] - expected.origin).max() < 1e-6
        assert np.quantile(np.abs(np.reshape(result["strain"], (-1, 3)) - expected.strain), 0.99) < 2e-3
        free = replace(head.avatar, strain_range=None).frames(mesh).strain
        assert (np.abs(free - expected.strain) > 0.01).mean() > 0.05  # the range matters here


def test_order_is_back_to_front(head, tmp_path):
    """Catches splats blended in the wrong order, left out or drawn twice."""
    result = evaluated(head.data(exact=True), tmp_path)["results"][0]
    splats = head.avatar.splats.rows(np.argsort(head.avatar.splats.face, kind="stable"))
    frames = head.avatar.frames(head.meshes[0])
    turned = np.einsum("nij,nj->ni", frames.rotation[splats.face], splats.xyz)
    world = frames.scale[splats.face, None] * turned + frames.origin[splats.face]
    depth = head.camera.project(world)[1][result["order"]]
    assert sorted(result["order"]) == list(range(len(splats)))
    assert np.diff(depth).max() <= 2 * np.ptp(depth) / 65535


def test_damaged_files_are_refused_in_one_sentence(head, tmp_path):
    """Catches a player that hangs, or draws garbage, on a file that was cut off, altered or made by a later version."""
    whole = head.data()
    raw = gzip.decompress(whole)
    length = int.from_bytes(raw[8:12], "little")
    header = raw[12 : 12 + length]
    altered = [
        whole[: len(whole) // 2],
        b"PK" + whole,
        gzip.compress(raw[:-5]),
        gzip.compress(raw[:4] + b"\x09" + raw[5:]),
        gzip.compress(raw[:12] + header.replace(b'"fps": 2.0', b'"fps": -20') + raw[12 + length :]),
        gzip.compress(raw[:12] + header.replace(b'"planes": 1', b'"planes": 9', 1) + raw[12 + length :]),
        gzip.compress(raw[:12] + header.replace(b'"parents": [-1', b'"parents": [77', 1) + raw[12 + length :]),
        gzip.compress(raw[:8] + b"\xff\xff\xff\x7f" + raw[12:]),
    ]
    for data in altered:
        error = evaluated(data, tmp_path).get("error", "")
        assert error.startswith("DataError: "), error
        assert error.endswith("."), error


def test_an_avatar_without_motion_plays(head, tmp_path):
    """Catches a single frame, or an avatar without selection, color harmonics and strain, that the player refuses."""
    plain = make_head(sh_degree=0, strain=False)
    data = data_file(plain.avatar, baked_rig([plain.avatar.neutral]), Playback())
    vertices = evaluated(data, tmp_path)["results"][0]["vertices"]
    assert np.abs(np.reshape(vertices, (-1, 3)) - plain.avatar.neutral).max() < 1e-6
