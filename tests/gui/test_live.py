"""A head that is driven live, in a Blender with a window: see test_scenario.py."""

import json
import os
import shlex
from pathlib import Path

import numpy as np
import pytest
from flame.small_head import small_head, write_flame

from stga_addon.avatar.file import Avatar, write_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.development.package import build_zip

from .test_scenario import blender

BLENDER = shlex.split(os.environ.get("STGA_BLENDER", ""))
pytestmark = pytest.mark.skipif(
    not BLENDER, reason="STGA_BLENDER does not say how to start a Blender with a window"
)
MIN_POSES_PER_SECOND = 30
PICTURES = int(os.environ.get("STGA_GUI_PICTURES", "0"))


def test_a_phone_moves_the_head(tmp_path: Path) -> None:
    """Catches a head that lags behind a phone with splats on, or behind what a display by software
    draws, and Esc that does not stop it."""
    archive = build_zip(tmp_path)
    blender(
        tmp_path,
        "--command",
        "extension",
        "install-file",
        "--repo",
        "user_default",
        "--enable",
        archive,
    )
    model = small_head(0)
    write_flame(model, tmp_path / "flame.npz")
    np.savez(tmp_path / "own.npz", expr=np.zeros((3, model.n_expression)))
    splats = lattice_splats(model.v_template, model.faces, order=1)
    avatar = os.environ.get("STGA_GUI_AVATAR")
    if avatar:
        (tmp_path / "avatar.npz").write_bytes(Path(avatar).read_bytes())
    else:
        write_avatar(
            tmp_path / "avatar.npz",
            Avatar(splats, "stga", model.v_template.astype(np.float32), model.faces),
        )
    script = Path(__file__).with_name("live_script.py")
    blender(tmp_path, "--python", script, "--", tmp_path, PICTURES)
    seen = json.loads((tmp_path / "result.json").read_text())
    assert "traceback" not in seen, seen["traceback"]
    print(seen)
    assert seen["stopped by Esc"]
    assert PICTURES or seen["poses per second"] >= min(
        MIN_POSES_PER_SECOND, 0.9 * seen["draws per second"]
    )
