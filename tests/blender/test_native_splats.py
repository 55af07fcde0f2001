"""What Blender's native splats are drawn from, against numpy, also in STGA_BLENDER; files that go
between Blenders with and without them."""

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose

from stga_addon.avatar.embedding import to_world
from stga_addon.avatar.file import write_avatar
from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.color import linear_to_srgb
from stga_addon.flame.quaternions import to_matrices
from stga_addon.flame.sequence import neutral_mesh
from stga_addon.scene import compat
from stga_addon.scene.arrays import evaluated_vertices
from stga_addon.scene.display import splat_nodes
from stga_addon.scene.display.splat_attributes import read_native_splats
from stga_addon.scene.display.splat_nodes import MAX_BASE, MIN_BASE, NATIVE, POINTS, QUADS
from stga_addon.scene.display.splat_object import set_input, show_avatar
from stga_addon.scene.layers import FROZEN_COLOR
from stga_addon.scene.rig.head import import_head, rig_of

from .captures import flame_model, flame_sequence, motion_capture
from .session import open_file, ops, panel, point_clouds, reopen, save
from .test_operators import write_ball_avatar
from .test_splat_object import driven_avatar, same_rotation
from .test_versions import python_of
from .zips import BLENDERS, output_of, result_of

FILE_SCRIPT = Path(__file__).with_name("native_file_script.py")
SCRIPT = Path(__file__).with_name("native_script.py")
OPTIONS = ["--background", "--python-exit-code", "1", "--python"]
COMMANDS = [[sys.executable], *([*command, *OPTIONS] for command in BLENDERS)]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: Path(command[0]).name)
def test_native_splats_are_those_of_the_posed_avatar(command, tmp_path):
    """Catches an attribute that is missing, or named or activated in another way than Blender reads
    it: sizes as logarithms or without their factor, opacities as logits or dropped, splats that do
    not move with the mesh, harmonics in another order or turned with triangles, and colors without
    deformation, selection or new light, or that are not those fitted for linear light."""
    avatar = driven_avatar("stga", count=400)
    rng = default_rng(4)
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
    left = {name for name in found if name.startswith("recorded/stga")}
    assert not left or found["recorded/type"] == ""
    wanted = to_world(splats, avatar.frames(posed))
    assert_allclose(found["recorded/position"], wanted.xyz, atol=1e-5)
    assert same_rotation(found["recorded/rotation"], wanted.rotation) < 1e-3
    assert_allclose(found["recorded/scale"], 1.5 * np.exp(wanted.log_scale), rtol=1e-3)
    fitted = default_rng(1).uniform(-1, 1, (400, 4))
    opacity = 1 / (1 + np.exp(-np.stack([splats.opacity.astype(np.float64), fitted[:, 3]])))
    driven = wanted.sh[:, 0] - splats.sh[:, 0]  # by the deformation
    bases = dict.fromkeys(("recorded", "constant"), wanted.sh[:, 0])
    bases["fitted"] = fitted[:, :3] + driven
    relit = default_rng(0).uniform(0, 2, (400, 4))[:, :3]
    flat = {"gray": np.array(FROZEN_COLOR[:3]), "relit": relit}
    bases |= {case: (linear_to_srgb(color) - 0.5) / SH_C0 for case, color in flat.items()}
    for case, base in bases.items():
        # from black to a little above white
        expected = np.clip(np.broadcast_to(base, (400, 3)), -0.5 / SH_C0, 0.62 / SH_C0)
        assert_allclose(found[f"{case}/radiance:base"][:, :3], expected, atol=5e-5)
        alpha = opacity[int(case in ("fitted", "relit"))]  # which comes after it
        assert_allclose(found[f"{case}/radiance:base"][:, 3], alpha, atol=1e-6)
        names = [name for name in found if name.startswith(f"{case}/radiance:sh_")]
        assert sorted(names) == sorted(f"{case}/radiance:sh_{index}" for index in range(15))
        for index in range(15):
            coefficient = (
                wanted.sh[:, index + 1] if case in ("recorded", "fitted") else 0 * wanted.sh[:, 0]
            )
            assert_allclose(found[f"{case}/radiance:sh_{index}"], coefficient, atol=1e-6)


def covariance(splats):
    """(N, 3, 3), which does not tell one order and sign of the axes from another."""
    axes = to_matrices(splats.rotation.astype(np.float64))
    axes = axes * np.exp(splats.log_scale.astype(np.float64))[:, None]
    return axes @ axes.swapaxes(1, 2)


@pytest.mark.skipif(not compat.NATIVE_SPLATS, reason="Blender before 5.3 has no native splats")
def test_native_splats_follow_bones_shape_keys_and_strain(tmp_path):
    """Catches nodes that are exact on a mesh given as such, and not on an evaluated rig."""
    sequence = flame_sequence(flame_model(300))
    head = import_head(motion_capture(sequence, tmp_path / "motion.npz"))
    rig = rig_of(head)
    keys = head.data.shape_keys
    rig.animation_data.action = keys.animation_data.action = None
    some = driven_avatar("stga", count=800)
    faces = sequence.model.faces
    count = len(faces)
    avatar = replace(
        some,
        splats=replace(some.splats, face=some.splats.face % count),
        neutral=neutral_mesh(sequence).astype(np.float32),
        faces=faces,
        strain_range=some.strain_range[:count],
        driven_offsets={name: each[:count] for name, each in some.driven_offsets.items()},
    )
    shown = show_avatar(avatar, head)
    set_input(shown, splat_nodes.DISPLAY, NATIVE)
    rng = default_rng(3)
    sliders = [key for key in keys.key_blocks if key.name.startswith("expr")]
    before = evaluated_vertices(head)
    for _ in range(10):
        for bone in rig.pose.bones:
            bone.rotation_mode = "XYZ"
            bone.rotation_euler = rng.normal(0, 0.3, 3)
        for key in sliders:
            key.value = rng.normal()
        bpy.context.view_layer.update()
        posed = evaluated_vertices(head)
        assert np.abs(posed - before).max() > 0.01
        wanted = to_world(avatar.splats, avatar.frames(posed))
        (cloud,) = map(read_native_splats, point_clouds())
        assert_allclose(cloud.xyz, wanted.xyz, atol=1e-5)
        size = np.exp(wanted.log_scale).max(1)[:, None, None]
        found, expected = (covariance(each) / size**2 for each in (cloud, wanted))
        assert_allclose(found, expected, atol=1e-5)
        assert_allclose(cloud.log_scale, wanted.log_scale, atol=1e-5)
        base = np.clip(wanted.sh[:, 0], MIN_BASE, MAX_BASE)
        assert_allclose(SH_C0 * cloud.sh[:, 0], SH_C0 * base, atol=1e-5)
        assert_allclose(cloud.opacities(), wanted.opacities(), atol=1e-5)


@pytest.fixture
def pretend(extension, monkeypatch):
    """Makes this Blender one that has native splats, which stay points where it has none, or one
    that has not."""
    known = extension.stga_addon.scene.compat

    def change(is_native):
        monkeypatch.setattr(known, "NATIVE_SPLATS", is_native)
        if not compat.NATIVE_SPLATS:
            monkeypatch.setattr(known, "native_splats", lambda tree, points, left_out: points)

    return change


@pytest.mark.parametrize("shows_again", [False, True])
def test_a_file_from_before_native_splats_can_show_them(
    extension, head, pretend, tmp_path, shows_again
):
    """Catches a menu that lacks the mode that the panel offers, also after Show Avatar, and
    settings lost with the old node tree."""
    splat_object = extension.stga_addon.scene.display.splat_object
    path = str(tmp_path / "a.npz")
    write_ball_avatar(tmp_path / "a.npz")
    pretend(False)
    ops.show_avatar(filepath=path)
    splat_object.set_input(panel().splats, splat_nodes.SIZE, 1.5)
    save(tmp_path / "a.blend")
    pretend(True)
    open_file(tmp_path / "a.blend")
    settings = panel()
    if shows_again:
        ops.show_avatar(filepath=path)
        splat_object.set_input(settings.splats, splat_nodes.DISPLAY, NATIVE)
    elif compat.NATIVE_SPLATS:
        ops.choose_display(display=NATIVE)
    else:  # where the operator does not offer it
        splat_object.choose_display(settings.splats, NATIVE)
    assert splat_object.display_mode(settings.splats) == NATIVE
    assert splat_object.get_input(settings.splats, splat_nodes.SIZE) == 1.5
    assert splat_object.get_input(settings.splats, splat_nodes.HEAD) == settings.head
    (data,) = point_clouds()
    assert not compat.NATIVE_SPLATS or data.type == "GAUSSIAN_SPLAT"


def test_world_splats_of_an_older_file_can_be_native(extension, pretend, tmp_path):
    """Catches splats without a head that keep a tree without native splats."""
    splat_object = extension.stga_addon.scene.display.splat_object
    splats = driven_avatar("stga", count=20).splats
    pretend(False)
    shown = splat_object.show_world_splats(splats, "room")
    pretend(True)
    splat_object.choose_display(shown, NATIVE)
    assert splat_object.display_mode(shown) == NATIVE


def test_native_splats_become_quads_in_an_older_blender(extension, head, pretend, tmp_path, capsys):
    """Catches a file from a newer Blender that shows nothing, and no sentence that says why."""
    splat_object = extension.stga_addon.scene.display.splat_object
    write_ball_avatar(tmp_path / "a.npz")
    pretend(True)
    ops.show_avatar(filepath=tmp_path / "a.npz")
    shown = panel().splats
    splat_object.set_input(shown, splat_nodes.DISPLAY, NATIVE)
    reopen(tmp_path / "a.blend")
    assert splat_object.display_mode(panel().splats) == NATIVE
    pretend(False)
    open_file(tmp_path / "a.blend")
    shown = panel().splats
    sentence = f"{shown.name} is displayed as {QUADS}; native splats need Blender 5.3 or newer"
    assert splat_object.display_mode(shown) == QUADS
    assert f"STGA: {sentence}\n" in capsys.readouterr().out
    assert bpy.context.window_manager.stga_message == sentence
    shutil.copy(tmp_path / "a.blend", tmp_path / "library.blend")
    with bpy.data.libraries.load(str(tmp_path / "library.blend")) as (_, target):
        target.objects = [shown.name]
    assert splat_object.display_mode(target.objects[0]) == (QUADS if compat.APPENDED else NATIVE)
    ops.choose_display(display=POINTS)
    ops.show_avatar(filepath=tmp_path / "a.npz")
    assert splat_object.display_mode(shown) == POINTS


@pytest.mark.parametrize("is_written_by_newer", [False, True])
def test_files_between_blenders_with_and_without_native_splats(tmp_path, is_written_by_newer):
    """Catches what other versions store of modifiers and nodes in another way than is simulated
    above."""
    others = ("5.2", "this") if compat.NATIVE_SPLATS else ("this", "5.3")
    older, newer = map(python_of, others)
    write_avatar(tmp_path / "a.npz", driven_avatar("stga", count=50))
    writer = newer if is_written_by_newer else older
    reader = older if is_written_by_newer else newer
    file = tmp_path / "a.blend"
    output_of([writer, FILE_SCRIPT, "write", file, tmp_path / "a.npz"])
    found = result_of([reader, FILE_SCRIPT, "read", file])
    assert found["native"] != is_written_by_newer
    assert found["mode"] == (QUADS if is_written_by_newer else NATIVE)
    assert found["sentence"].startswith("head splats is displayed") == is_written_by_newer
    assert (found["size"], found["head"]) == (1.5, "head")
    assert found["drawn"] > 0
