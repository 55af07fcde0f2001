"""The built zip in every supported Blender: install, import, select, train, show, reenact, export,
save, uninstall.

The versions are Pythons with that bpy, named by environment variables; one that is not named skips.
Where they have no torch, the Python that runs the tests trains for them.
"""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from capture.factory import ball, write_flame_capture
from numpy.testing import assert_allclose

from stga_addon.avatar.embedding import to_world
from stga_addon.avatar.file import Avatar, read_avatar, write_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.avatar.offsets import OFFSETS
from stga_addon.capture.open import open_capture
from stga_addon.development.package import build_zip
from stga_addon.export.ply import read_ply
from stga_addon.flame.forward import FlameFrame, flame_forward
from stga_addon.flame.sequence import read_motion
from stga_addon.worker.training_python import missing_packages

from .zips import result_of

# bpy that the tests themselves run in, and others: (version, the variable with the path of a Python
# that has it)
TRAINING_PYTHON = "" if missing_packages() else sys.executable
VERSIONS = {"this": None} | {
    version: f"STGA_BPY_{version.replace('.', '_')}" for version in ("4.2", "4.5", "5.2", "5.3")
}


def python_of(version):
    variable = VERSIONS[version]
    python = sys.executable if variable is None else os.environ.get(variable)
    if not python:
        pytest.skip(f"no Python with bpy {version}: set {variable} to one")
    return python


@pytest.mark.slow
@pytest.mark.parametrize(
    "version",
    ["this", *(pytest.param(v, marks=pytest.mark.nightly) for v in VERSIONS if v != "this")],
)
@pytest.mark.usefixtures("zip_file")  # whose wheels are needed
def test_the_whole_workflow(version, kernel_bundle, tmp_path):
    """Catches what works in the checkout, or in one Blender, and not in the zip, or in another."""
    python = python_of(version)
    folder, model = write_flame_capture(tmp_path / "capture")
    model.rename(tmp_path / "model.npz")
    capture = open_capture(folder, tmp_path / "model.npz")
    faces = ball()[1].astype(np.int32)
    rng = np.random.default_rng(2)
    splats = lattice_splats(capture.neutral, faces, order=0)
    positions = rng.normal(0, 0.003, (len(faces), 3, 3)).astype(np.float32)
    neutral = capture.neutral.astype(np.float32)
    avatar = Avatar(
        splats, "stga", neutral, faces, driven_offsets=dict.fromkeys(OFFSETS, positions)
    )
    write_avatar(tmp_path / "a.npz", avatar)
    moving = {"expr": rng.normal(size=(5, 2)), "pose": rng.normal(0, 0.3, (5, 15))}
    other = moving | {"shape": np.ones(4)}
    np.savez(tmp_path / "other.npz", **other)

    kernels = sorted(kernel_bundle[0].glob("*/*"))
    result = run(python, build_zip(tmp_path / "dist", kernels=kernels), tmp_path)
    assert version == "this" or result["version"].startswith(version)
    assert result["heavy"] == []
    assert {f"STGA_PT_{step}" for step in ("capture", "select", "train", "show")} <= {
        *result["tabs"]
    }
    assert max(result["counted"]) > 0
    assert result["left"] == []
    if result["can train"] or TRAINING_PYTHON:
        assert result["trained"] == len(read_avatar(tmp_path / "run/avatar.npz").splats)
    own = capture.flame
    pair = read_motion(tmp_path / "pair/flame_param.npz", own.model)
    for row in range(5):
        pose = other["pose"][row]
        turns = (pose[:3], pose[3:6], pose[6:9], np.zeros(3), pose[9:])
        frame = FlameFrame(other["expr"][row], *turns)
        mesh = flame_forward(own.model, own.shape, frame, own.static_offset)
        expected = to_world(avatar.splats, avatar.frames(mesh)).xyz
        written = read_ply(tmp_path / f"plys/{1 + row:05d}.ply").xyz
        assert_allclose(written, expected, atol=1e-5)
        assert_allclose(pair.frame(row).pose, frame.pose, atol=1e-5)
        if 1 + row == result["frame"]:
            assert_allclose(np.reshape(result["shown"], (-1, 3)), expected, atol=1e-5)


def run(python, archive, folder):
    """What `workflow.py` reports, from a fresh Blender profile."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment = kept | {"BLENDER_USER_RESOURCES": str(folder / "profile")}
    script = str(Path(__file__).with_name("workflow.py"))
    return result_of([python, script, archive, folder, TRAINING_PYTHON], env=environment)
