"""Sheets of avatars from all sides and in poses."""

from itertools import combinations
from types import SimpleNamespace

import numpy as np
from PIL import Image
from refusal import refusal

from stga_addon.avatar.file import Avatar, write_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.avatar.splats import SH_C0
from stga_addon.development.benchmark import all_sides
from stga_addon.flame.forward import neutral_frame
from stga_addon.flame.parts import flame_model
from stga_addon.flame.sequence import FlameSequence


def test_directions_and_poses(tmp_path, monkeypatch):
    """Catches directions in another order, a pose that is another one's or none, a run whose
    head has no such expressions, and a picture of another format than its name says."""
    model = flame_model(None)
    zero = np.zeros(model.n_identity)
    sequence = FlameSequence(model, zero, None, (0,), lambda _: neutral_frame(model))
    capture = SimpleNamespace(flame=sequence)
    monkeypatch.setattr(all_sides, "open_refined", lambda run: capture)
    faces = model.faces
    center = model.v_template[faces].mean(1)
    splats = lattice_splats(model.v_template, faces, order=0)
    color = np.where(center[:, :1] > 0, [1, 0, 0], [0, 1, 0])  # the person's left is red
    color[center[:, 2] < -0.02] = [0, 0, 1]  # the back blue
    splats.sh[:, 0] = (color[splats.face] - 0.5) / SH_C0
    splats.opacity[:] = 4
    avatar = Avatar(splats, "stga", model.v_template.astype(np.float32), faces)
    write_avatar(tmp_path / "avatar.npz", avatar)
    files = [tmp_path / "sides.png", tmp_path / "poses.jpg"]
    words = [str(tmp_path), "--sides", str(files[0]), "--poses", str(files[1])]
    monkeypatch.setattr("sys.argv", ["all_sides", *words])
    all_sides.main()
    pictures = [Image.open(file) for file in files]
    assert [picture.format for picture in pictures] == ["PNG", "JPEG"]
    sides, poses = (np.asarray(picture, float) for picture in pictures)
    columns = np.split(np.pad(sides, ((0, 0), (0, 6), (0, 0))), 8, axis=1)
    middle = [column[120:240, 100:220].mean((0, 1)).argmax() for column in columns]
    assert [middle[0], *middle[2:7:2]] in ([0, 0, 2, 1], [1, 0, 2, 1])
    assert poses.shape == (400, 6 * 326 - 6, 3)
    meshes = [mesh for _, mesh in all_sides.shots_of(tmp_path)[1]]
    moved = [np.abs(one - other).max() for one, other in combinations(meshes, 2)]
    assert min(moved) > 2e-3
    capture.flame = None
    with refusal("has no expressions by ARKit's names"):
        all_sides.main()
