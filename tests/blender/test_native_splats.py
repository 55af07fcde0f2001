"""What Blender's native splats are drawn from, against numpy; also in STGA_BLENDER."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stga_addon.avatar.embedding import to_world
from stga_addon.avatar.file import write_avatar
from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.color import linear_to_srgb
from stga_addon.scene.layers import FROZEN_COLOR

from .test_splat_object import driven_avatar, same_rotation
from .zips import BLENDERS, output_of

SCRIPT = Path(__file__).with_name("native_script.py")
OPTIONS = ["--background", "--python-exit-code", "1", "--python"]
COMMANDS = [[sys.executable], *([*command, *OPTIONS] for command in BLENDERS)]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: Path(command[0]).name)
def test_native_splats_are_those_of_the_posed_avatar(command: list[str], tmp_path: Path) -> None:
    """Catches an attribute that is missing, or named or activated in another way than Blender reads
    it: sizes as logarithms or without their factor, opacities as logits or dropped, splats that do
    not move with the mesh, harmonics in another order or turned with triangles, and colors without
    deformation, selection or new light."""
    avatar = driven_avatar("stga", count=400)
    rng = np.random.default_rng(4)
    splats = replace(avatar.splats, sh=rng.normal(0, 0.4, (400, 16, 3)).astype(np.float32))
    avatar = replace(avatar, splats=splats)
    turn = [[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]]
    posed = avatar.neutral @ turn + rng.normal(0, 0.004, avatar.neutral.shape)
    write_avatar(tmp_path / "a.npz", avatar)
    np.save(tmp_path / "head.npy", posed)
    files = (tmp_path / name for name in ("a.npz", "head.npy", "found.npz"))
    output_of([*command, SCRIPT, "--", *files])
    found = np.load(tmp_path / "found.npz")
    assert found["recorded/type"] in ("", "GAUSSIAN_SPLAT")
    wanted = to_world(splats, avatar.frames(posed))
    np.testing.assert_allclose(found["recorded/position"], wanted.xyz, atol=1e-5)
    assert same_rotation(found["recorded/rotation"], wanted.rotation) < 1e-3
    np.testing.assert_allclose(found["recorded/scale"], 1.5 * np.exp(wanted.log_scale), rtol=1e-3)
    opacity = 1 / (1 + np.exp(-splats.opacity.astype(np.float64)))
    relit = np.random.default_rng(0).uniform(0, 2, (400, 4))[:, :3]
    flat = {"gray": np.array(FROZEN_COLOR[:3]), "relit": relit}
    for case in ("recorded", "constant", *flat):
        base = (linear_to_srgb(flat[case]) - 0.5) / SH_C0 if case in flat else wanted.sh[:, 0]
        expected = np.broadcast_to(base, (400, 3))
        np.testing.assert_allclose(found[f"{case}/radiance:base"][:, :3], expected, atol=5e-5)
        np.testing.assert_allclose(found[f"{case}/radiance:base"][:, 3], opacity, atol=1e-6)
        names = [name for name in found if name.startswith(f"{case}/radiance:sh_")]
        assert sorted(names) == sorted(f"{case}/radiance:sh_{index}" for index in range(15))
        for index in range(15):
            coefficient = wanted.sh[:, index + 1] if case == "recorded" else 0 * wanted.sh[:, 0]
            np.testing.assert_allclose(found[f"{case}/radiance:sh_{index}"], coefficient, atol=1e-6)
