"""Open Demo Shot: the demo's capture, its training, and the film scene around its avatar."""

from dataclasses import replace
from pathlib import Path

import bpy
import pytest
from capture.factory import write_avatar_of

from stga_addon.avatar.file import UNSEEN_REGION, read_avatar, write_avatar
from stga_addon.capture.open import open_capture
from stga_addon.development.demo.capture import unpack_capture
from stga_addon.scene.display import splat_nodes
from stga_addon.scene.display.splat_object import get_input, is_partly_observed
from stga_addon.scene.render.film_set import shows_set
from stga_addon.scene.render.viewport_display import ENGINE

from .session import ops, panel

TRAINED = """
shutil.copyfile({avatar!r}, FOLDER.parent / "avatar.npz")
end("finished")
"""


@pytest.fixture
def trained(extension, stand_in, monkeypatch, tmp_path):
    """The demo of the complete edition, which a stand-in trains."""
    unpack_capture(tmp_path / "demo_capture")
    capture = open_capture(tmp_path / "demo_capture")
    avatar = write_avatar_of(capture, tmp_path / "trained.npz", is_colored=True)
    behind = capture.neutral[capture.faces].mean(1)[:, 2] < 0
    regions = {**capture.regions, UNSEEN_REGION: behind}
    write_avatar(avatar, replace(read_avatar(avatar), regions=regions))
    importing = extension.operators.import_capture
    monkeypatch.setattr(importing, "DEMO", tmp_path / "demo_capture")
    users = lambda package, path, create: str(tmp_path / path)  # noqa: E731
    monkeypatch.setattr(bpy.utils, "extension_path_user", users)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.setattr(extension.operators.train, "missing_packages", lambda: ["torch"])
    stand_in(TRAINED.format(avatar=str(avatar)))


@pytest.mark.slow
@pytest.mark.usefixtures("trained")
def test_open_demo_shot(tmp_path):
    """Catches a button after which nothing is built, a shot without its avatar, speech or set, one
    that is built around another avatar later, cameras of a capture in place of its own, and the
    demo's person in blue where nothing was filmed."""
    ops.open_demo(shot=True)
    scene = bpy.context.scene
    assert Path(panel().avatar) == tmp_path / "STGA Demo/run/avatar.npz"
    assert scene.render.engine == ENGINE
    assert scene.camera.name == "Shot"
    assert shows_set(scene)
    assert is_partly_observed(panel().splats)
    assert not get_input(panel().splats, splat_nodes.SHOW_UNSEEN)
    head = panel().head
    assert head.parent.parent_bone == "chest"
    opened = []
    for frame in range(1, 60, 3):
        scene.frame_set(frame)
        opened.append(head.data.shape_keys.key_blocks["jawOpen"].value)
    assert min(opened) < 0.05
    assert max(opened) > 0.25
    objects = len(scene.objects)
    ops.train(directory=panel().run_folder, minutes=0.1)
    assert len(scene.objects) == objects
