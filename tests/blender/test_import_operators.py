"""Importing heads without a capture, and importing again."""

from functools import partial
from pathlib import Path

import bpy
import numpy as np
import pytest
from capture.factory import (
    ball,
    flame_parameters,
    moved,
    write_flame_capture,
    write_flame_model,
    write_mesh,
    write_mesh_capture,
)

from stga_addon.capture.open import open_capture
from stga_addon.scene.arrays import evaluated_vertices
from stga_addon.scene.display.splat_object import evaluated_splats

from .test_operators import write_ball_avatar

pytestmark = pytest.mark.usefixtures("extension")


@pytest.fixture
def model(tmp_path) -> Path:
    return write_flame_model(tmp_path / "model.npz")


def write_motion(path: Path, timesteps: int = 4) -> Path:
    """All timesteps in one file, as VHAP's tracker leaves it."""
    frames = [flame_parameters(timestep) for timestep in range(timesteps)]
    names = [name for name, value in frames[0].items() if value.ndim == 2]
    moving = {name: np.concatenate([frame[name] for frame in frames]) for name in names}
    np.savez(path, **moving, shape=frames[0]["shape"], static_offset=frames[0]["static_offset"])
    return path


def write_meshes(folder: Path, timesteps: int = 3) -> Path:
    folder.mkdir()
    vertices, faces = ball()
    for timestep in range(timesteps):
        write_mesh(folder / f"{timestep:03d}.obj", moved(timestep, vertices), faces)
    return folder / "001.obj"


def state_of_file() -> dict[str, list[str]]:
    kinds = "objects meshes actions armatures collections node_groups materials cameras images"
    return {kind: sorted(block.name for block in getattr(bpy.data, kind)) for kind in kinds.split()}


def test_a_motion_file_is_a_rig(tmp_path, model):
    """Catches a motion that can be imported and then not worked with, because there is no folder
    around it."""
    path = write_motion(tmp_path / "tracked_flame_params_30.npz")
    bpy.ops.stga.import_motion(filepath=str(path), flame=str(model))
    scene, capture = bpy.context.scene, open_capture(path, model)
    assert (scene.frame_start, scene.frame_end) == (0, 3)
    for timestep in capture.timesteps:
        scene.frame_set(timestep)
        found = evaluated_vertices(scene.stga.head)
        np.testing.assert_allclose(found, capture.mesh(timestep), atol=2e-6)
    bpy.ops.stga.select(threshold=0.001)


@pytest.mark.parametrize("kind", ["capture", "flame", "motion", "meshes"])
def test_importing_again_doubles_nothing(tmp_path, model, kind):
    """Catches a second head, rig, camera, action or image for the same source, and an import of the
    one mesh that was clicked."""
    folder, ops = tmp_path / "source", bpy.ops.stga
    write = {"capture": write_mesh_capture, "flame": write_flame_capture, "motion": write_motion}
    written = {**write, "meshes": write_meshes}[kind](folder)
    bring = {
        "capture": partial(ops.import_capture, directory=str(folder)),
        "flame": partial(ops.import_capture, directory=str(folder), flame=str(model)),
        "motion": partial(ops.import_motion, filepath=f"{folder}.npz", flame=str(model)),
        "meshes": partial(ops.import_meshes, filepath=str(written)),
    }[kind]
    bring()
    once = state_of_file()
    bring()
    assert state_of_file() == once
    if kind == "meshes":
        bpy.context.scene.frame_set(2)
        found = evaluated_vertices(bpy.context.scene.stga.head)
        np.testing.assert_allclose(found, moved(2, ball()[0]), atol=1e-6)


def test_importing_again_keeps_what_an_artist_painted(tmp_path):
    """Catches regions, materials and selections that vanish because a capture was read again."""
    folder = write_mesh_capture(tmp_path / "capture")
    bpy.ops.stga.import_capture(directory=str(folder))
    head = bpy.context.scene.stga.head
    head.vertex_groups.new(name="dimple").add([3, 4, 5], 1.0, "REPLACE")
    head.vertex_groups.new(name="stga_3").add([7], 0.7, "REPLACE")
    head.data.materials.append(bpy.data.materials.new("skin"))
    bpy.ops.stga.import_capture(directory=str(folder))
    assert bpy.context.scene.stga.head == head
    assert head.vertex_groups["dimple"].weight(4) == 1.0
    assert head.vertex_groups["stga_3"].weight(7) == pytest.approx(0.7)
    assert [material.name for material in head.data.materials] == ["skin"]
    bpy.context.scene.frame_set(3)
    np.testing.assert_allclose(evaluated_vertices(head), moved(3, ball()[0]), atol=1e-6)


def test_what_came_in_is_selected(tmp_path):
    """Catches an import that leaves an artist's other objects selected, or in edit mode, and its
    head hard to find."""
    mesh = bpy.data.meshes.new("other")
    other = bpy.data.objects.new("other", mesh)
    bpy.context.scene.collection.objects.link(other)
    bpy.context.view_layer.objects.active = other
    other.select_set(True)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.stga.import_capture(directory=str(write_mesh_capture(tmp_path / "capture")))
    head = bpy.context.scene.stga.head
    assert other.mode == "OBJECT"
    assert bpy.context.selected_objects == [head]
    assert bpy.context.view_layer.objects.active == head
    cameras = [thing for thing in bpy.data.objects if thing.type == "CAMERA"]
    for camera in cameras:
        assert camera.data.display_size < 0.3 * camera.matrix_world.translation.length


def test_wrong_files_change_nothing(tmp_path, model):
    """Catches half an import, a traceback, and a sentence that does not name the file."""
    (tmp_path / "noise.npz").write_bytes(b"no archive")
    np.savez(tmp_path / "other.npz", xyz=np.zeros(3))
    (tmp_path / "empty").mkdir()
    before = state_of_file()
    write_motion(tmp_path / "a.npz")
    for name, flame, message in (
        ("noise.npz", model, "noise"),
        ("other.npz", model, "has none of expr"),
        ("gone.npz", model, "gone"),
        ("other.npz", "", "choose your FLAME model in the add-on's preferences"),
        ("a.npz", tmp_path / "no model.npz", "no model"),
    ):
        with pytest.raises(RuntimeError, match=message):
            bpy.ops.stga.import_motion(filepath=str(tmp_path / name), flame=str(flame))
    with pytest.raises(RuntimeError, match="is not a capture"):
        bpy.ops.stga.import_meshes(filepath=str(tmp_path / "empty/a.obj"))
    assert state_of_file() == before
    assert bpy.context.scene.stga.head is None


def test_linked_heads_are_left_alone(tmp_path):
    """Catches changes to, or tracebacks about, what belongs to another file."""
    folder = write_mesh_capture(tmp_path / "capture")
    bpy.ops.stga.import_capture(directory=str(folder))
    name = bpy.context.scene.stga.head.name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, target):
        target.collections = ["capture"]
    bpy.context.scene.collection.children.link(target.collections[0])
    linked = target.collections[0].objects[name]
    bpy.context.scene.stga.head = linked
    avatar = write_ball_avatar(tmp_path / "a.npz", order=0)
    bpy.ops.stga.show_avatar(filepath=str(tmp_path / "a.npz"))
    assert len(evaluated_splats(bpy.context.scene.stga.splats)[0]) == len(avatar.splats)
    assert not linked.hide_render
    for operator in ("select", "heat_map", "apply_motion"):
        with pytest.raises(RuntimeError, match="linked from another file"):
            getattr(bpy.ops.stga, operator)()
    bpy.ops.stga.import_capture(directory=str(folder))  # its own, beside the linked one
    assert bpy.context.scene.stga.head != linked
    assert bpy.context.scene.stga.head.library is None
