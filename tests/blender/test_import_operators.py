"""Importing heads without a capture, and importing again."""

from functools import partial
from types import SimpleNamespace

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
from numpy.testing import assert_allclose

from stga_addon.capture.open import open_capture
from stga_addon.development.demo.in_blender import evaluated_splats

from .captures import mesh_at
from .session import failure, import_flame, ops, panel, placed, save
from .test_operators import show_ball, write_ball_avatar

pytestmark = pytest.mark.usefixtures("extension")


@pytest.fixture
def model(tmp_path):
    return write_flame_model(tmp_path / "model.npz")


def write_motion(path, timesteps=4):
    """All timesteps in one file, as VHAP's tracker leaves it."""
    frames = [flame_parameters(timestep) for timestep in range(timesteps)]
    names = [name for name, value in frames[0].items() if value.ndim == 2]
    moving = {name: np.concatenate([frame[name] for frame in frames]) for name in names}
    np.savez(path, **moving, shape=frames[0]["shape"], static_offset=frames[0]["static_offset"])
    return path


def write_meshes(folder, timesteps=3):
    folder.mkdir()
    vertices, faces = ball()
    for timestep in range(timesteps):
        write_mesh(folder / f"{timestep:03d}.obj", moved(timestep, vertices), faces)
    return folder / "001.obj"


def state_of_file():
    kinds = "objects meshes actions armatures collections node_groups materials cameras images"
    return {kind: sorted(block.name for block in getattr(bpy.data, kind)) for kind in kinds.split()}


@pytest.mark.parametrize("kind", ["capture", "flame", "motion", "meshes"])
def test_importing_again_doubles_nothing(tmp_path, model, kind):
    """Catches a second head, rig, camera, action or image, other meshes than the source's, and a
    head that cannot be worked with because there is no folder around it."""
    folder = tmp_path / "source"

    flame = str(model)
    if kind == "motion":
        source = write_motion(tmp_path / "source.npz")
        bring = partial(ops.import_motion, filepath=str(source), flame=flame)
    elif kind == "meshes":
        source = write_meshes(folder)
        bring = partial(ops.import_meshes, filepath=str(source))
    else:
        (write_mesh_capture if kind == "capture" else write_flame_capture)(folder)
        source = folder
        own = {"flame": flame} if kind == "flame" else {}
        bring = partial(ops.import_capture, directory=str(folder), **own)
    bring()
    once = state_of_file()
    bring()
    assert state_of_file() == once
    scene = bpy.context.scene
    if kind == "meshes":
        meshes = {timestep: moved(timestep, ball()[0]) for timestep in range(3)}
    else:
        capture = open_capture(source, model if kind != "capture" else None)
        meshes = {timestep: capture.mesh(timestep) for timestep in capture.timesteps}
    assert (scene.frame_start, scene.frame_end) == (0, max(meshes))
    for timestep, mesh in meshes.items():
        assert_allclose(mesh_at(timestep), mesh, atol=2e-6)
    ops.select(threshold=0.001)


def test_importing_again_keeps_what_an_artist_painted(tmp_path):
    """Catches painted regions, materials and the head's own keyframes, which may be in the action
    of its shapes, lost by another import, and others left selected."""
    folder = write_mesh_capture(tmp_path / "capture")
    ops.import_capture(directory=folder)
    head = panel().head
    head.vertex_groups.new(name="dimple").add([3, 4, 5], 1.0, "REPLACE")
    head.vertex_groups.new(name="stga_3").add([7], 0.7, "REPLACE")
    head.data.materials.append(bpy.data.materials.new("skin"))
    for frame in (1, 5):
        head.pass_index = frame
        head.keyframe_insert("pass_index", frame=frame)
    ops.import_capture(directory=folder)
    assert panel().head == head
    bpy.context.scene.frame_set(1)
    assert head.pass_index == 1
    assert head.vertex_groups["dimple"].weight(4) == 1.0
    assert head.vertex_groups["stga_3"].weight(7) == pytest.approx(0.7)
    assert [material.name for material in head.data.materials] == ["skin"]
    assert_allclose(mesh_at(3), moved(3, ball()[0]), atol=1e-6)
    mesh = bpy.data.meshes.new("other")
    other = placed("other", mesh)
    bpy.context.view_layer.objects.active = other
    other.select_set(True)
    bpy.ops.object.mode_set(mode="EDIT")
    ops.import_capture(directory=write_mesh_capture(tmp_path / "second"))
    head = panel().head
    assert other.mode == "OBJECT"
    assert set(bpy.context.selected_objects) == {head, head.parent}
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
        with failure(message):
            ops.import_motion(filepath=tmp_path / name, flame=flame)
    with failure("is not a capture"):
        ops.import_meshes(filepath=tmp_path / "empty/a.obj")
    assert state_of_file() == before
    assert panel().head is None


def test_linked_heads_are_left_alone(tmp_path):
    """Catches changes to, or tracebacks about, what belongs to another file."""
    folder = write_mesh_capture(tmp_path / "capture")
    ops.import_capture(directory=folder)
    name = panel().head.name
    save(tmp_path / "library.blend")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, target):
        target.collections = [name.removesuffix(" head")]
    bpy.context.scene.collection.children.link(target.collections[0])
    linked = target.collections[0].objects[name]
    panel().head = linked
    avatar = show_ball(tmp_path / "a.npz", order=0)
    assert len(evaluated_splats(panel().splats)[0]) == len(avatar.splats)
    assert not linked.hide_render
    for operator in ("select", "heat_map", "apply_motion"):
        with failure("linked from another file"):
            getattr(ops, operator)()
    ops.import_capture(directory=folder)  # its own, beside the linked one
    assert panel().head != linked
    assert panel().head.library is None


HANDLERS = {
    "video": "stga.avatar_from_video",
    "capture": "stga.import_capture",
    "performance": "stga.apply_motion",
    "npz": "stga.open_npz",
    "ply": "stga.import_ply",
}


@pytest.mark.parametrize("name", HANDLERS)
def test_handlers_call_operators_that_take_a_file(name):
    """Catches a handler whose operator takes no file, and JSON dropped into the text editor."""
    handler = getattr(bpy.types, f"STGA_FH_{name}")
    assert handler.bl_import_operator == HANDLERS[name]
    operator = getattr(ops, HANDLERS[name].removeprefix("stga."))
    properties = operator.get_rna_type().properties
    assert properties["filepath"].subtype == "FILE_PATH"
    assert properties["filepath"].is_skip_save
    assert handler.poll_drop(SimpleNamespace(area=SimpleNamespace(type="VIEW_3D")))
    assert not handler.poll_drop(SimpleNamespace(area=SimpleNamespace(type="TEXT_EDITOR")))
    assert not handler.poll_drop(SimpleNamespace(area=None))


def test_a_file_stands_for_its_capture(tmp_path):
    """Catches a capture opened by one of its files only, and any file taken for one."""
    folder = write_mesh_capture(tmp_path / "capture")
    image = next(folder.rglob("*.png"))
    for given in (folder / "transforms_train.json", image, folder / "demo.blend"):
        bpy.ops.wm.read_homefile(use_empty=True)
        ops.import_capture(filepath=given)
        assert panel().head["stga_capture"] == str(folder)
    (tmp_path / "notes.json").write_text("{}")
    with failure(r"notes.json: is in no capture; choose"):
        ops.import_capture(filepath=tmp_path / "notes.json")


def test_an_npz_is_opened_by_its_content(tmp_path):
    """Catches an avatar taken for a motion, a second head, and a traceback for others."""
    avatar = tmp_path / "a.npz"
    motion = write_motion(tmp_path / "smile.npz")
    write_ball_avatar(avatar)
    np.savez(tmp_path / "other.npz", values=np.zeros(3))
    (tmp_path / "noise.npz").write_bytes(b"no archive")
    for name, sentence in (
        ("a.npz", ".*import a capture first"),
        ("smile.npz", ".* choose your FLAME model"),
        ("other.npz", "is neither an avatar .* nor a FLAME motion"),
        ("noise.npz", "cannot be read as an .npz file"),
        ("gone.npz", "cannot be read as an .npz file"),
    ):
        with failure(f"^Error: .*{name}: {sentence}"):
            ops.open_npz(filepath=tmp_path / name)
    import_flame(tmp_path / "capture")
    objects = len(bpy.data.objects)
    ops.open_npz(filepath=motion)
    assert len(bpy.data.objects) == objects
    assert [action for action in bpy.data.actions if "smile" in action.name]
    ops.open_npz(filepath=avatar)
    assert panel().splats is not None


def test_a_second_head_stands_beside_the_first(extension, head, tmp_path):
    """Catches a head inside another one, a scene that changes under one's hands, a panel that
    speaks of the first head still, and a folder that two heads share."""
    scene = bpy.context.scene
    settings = scene.stga
    show_ball(tmp_path / "avatar.npz")
    splats = settings.splats
    settings.run_folder = str(tmp_path / "first run")
    kept = ("camera", "frame_start", "frame_end", "frame_current")
    before = [getattr(scene, name) for name in kept]
    size = scene.render.resolution_x
    second = write_mesh_capture(tmp_path / "second", timesteps=(20, 21))
    ops.import_capture(directory=second)
    other = settings.head
    assert other != head
    right = max((head.matrix_world @ vertex.co).x for vertex in head.data.vertices)
    left = min((other.matrix_world @ vertex.co).x for vertex in other.data.vertices)
    assert left - right == pytest.approx(0.1, abs=0.02)
    assert [getattr(scene, name) for name in kept] == before
    assert scene.render.resolution_x == size
    assert (settings.splats, settings.avatar) == (None, "")
    assert settings.run_folder == str(tmp_path / "second_run")
    bpy.context.view_layer.objects.active = head.parent
    bpy.context.view_layer.update()
    assert (settings.head, settings.splats) == (head, splats)
    assert settings.run_folder == str(tmp_path / "first run")
    settings.head = other  # chosen in the panel: it stays, whatever is active
    bpy.context.view_layer.update()
    assert settings.head == other
    place = other.parent.location.copy()
    ops.import_capture(directory=second, set_up_scene=True)
    assert scene.frame_start == 20
    assert other.parent.location == place
