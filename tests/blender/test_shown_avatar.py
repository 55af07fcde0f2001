"""Which head the result of a request reaches, and by which splat object an avatar is shown."""

import re
from contextlib import suppress
from pathlib import Path

import bpy
import numpy as np
import pytest
from capture.factory import write_mesh_capture

from stga_addon.avatar.file import read_avatar
from stga_addon.development.demo.in_blender import evaluated_splats
from stga_addon.export.ply import write_ply
from stga_addon.jobs.table import Kind
from stga_addon.progress import Progress
from stga_addon.scene import tags
from stga_addon.scene.arrays import evaluated_vertices, mesh_vertices
from stga_addon.scene.compat import modifier_input, modifier_input_owner
from stga_addon.scene.display import splat_nodes
from stga_addon.scene.display.splat_object import (
    get_input,
    input_identifier,
    set_input,
    splat_modifier,
)
from stga_addon.scene.light import throws_shadow
from stga_addon.training.run.folder import Run, write_run
from stga_addon.training.settings import make_settings

from .captures import mesh_at
from .session import bring, open_file, ops, panel, reopen, save, state_of
from .test_operators import expected_world, show_ball, write_ball_avatar, write_ball_run
from .test_train_operators import tick_until


def splat_objects():
    return [thing for thing in bpy.data.objects if thing.get(tags.KIND) == tags.SPLATS]


@pytest.fixture
def ben(head, tmp_path):
    """A second head of the same triangles, which the panel holds once it is imported."""

    def arrive():
        with suppress(ReferenceError):  # it was deleted
            head.name = "Anna"  # as a user renames it
        ops.import_capture(directory=write_mesh_capture(tmp_path / "ben"))
        panel().head.name = "Ben"
        return panel().head

    return arrive


def end(worker, iterations=5000, cancel=False, **options):
    """Let the worker end with an avatar."""
    if cancel:
        ops.cancel(request="training")
    worker.report(Progress(0.9, "Ending", figures=lambda: {"iteration": iterations}))
    write_ball_avatar(worker.run / "avatar.npz", **options)
    worker.leave()
    return worker.run / "avatar.npz"


@pytest.mark.parametrize("reopens", [False, True])
def test_a_result_reaches_the_head_it_was_trained_for(extension, worker, ben, tmp_path, reopens):
    """Catches Anna's previews and avatar on Ben, whom the panel holds meanwhile, and his mesh
    hidden; and Ben's avatar replaced in the panel."""
    monitor = extension.operators.monitor
    path = str(tmp_path / "both.blend")
    ben()
    write_ball_avatar(tmp_path / "ben.npz")
    ops.show_avatar(filepath=tmp_path / "ben.npz", hide_head=False)
    if reopens:
        reopen(path)
    settings = panel()
    anna = bpy.data.objects["Anna"]
    write_ball_avatar(worker.folder / "preview.npz")
    tick_until(monitor, lambda: len(splat_objects()) == 2)
    end(worker)
    tick_until(monitor, lambda: settings.result_shown)
    followed = {get_input(each, splat_nodes.HEAD): each for each in splat_objects()}
    assert {thing.name for thing in followed} == {"Anna", "Ben"}
    assert anna[tags.AVATAR] == str(worker.run / "avatar.npz")
    assert (anna.hide_render, settings.head.hide_render, settings.head.name) == (True, False, "Ben")
    assert settings.splats == followed[settings.head]
    assert Path(bpy.path.abspath(settings.avatar)) == tmp_path / "ben.npz"
    settings.head = anna
    assert settings.splats == followed[anna]
    assert Path(bpy.path.abspath(settings.avatar)) == worker.run / "avatar.npz"


def test_a_result_whose_head_is_gone_reaches_no_other(extension, worker, ben, head):
    """Catches an avatar on another head of as many triangles, and one that is lost silently."""
    ben()
    bpy.data.objects.remove(head)
    avatar = end(worker)
    settings = panel()
    tick_until(extension.operators.monitor, lambda: settings.result_shown)
    assert not splat_objects()
    assert not settings.head.hide_render
    assert settings.avatar == str(avatar)
    error = state_of(Kind.TRAINING).error
    assert error.endswith("is no longer in the scene; choose a head, then Show Avatar")


def test_a_head_that_was_imported_again_is_found(extension, worker, ben, head, tmp_path):
    """Catches an avatar that does not find the head of its own capture."""
    run = Run(tmp_path / "capture", None, "vhap", make_settings("global", iterations=5))
    write_run(worker.run, run)
    bpy.data.objects.remove(head)
    ops.import_capture(directory=tmp_path / "capture")
    ben()
    end(worker)
    tick_until(extension.operators.monitor, lambda: panel().result_shown)
    (shown,) = splat_objects()
    assert get_input(shown, splat_nodes.HEAD)[tags.CAPTURE] == str(tmp_path / "capture")


def test_a_head_is_found_after_undo(extension, worker, head):
    """Catches a training that undo detaches from its head."""
    monitor = extension.operators.monitor
    settings = panel()
    settings.training_head = None  # as before the training began
    settings.training_run = ""
    monitor.tick()
    assert settings.training_head == head


@pytest.mark.parametrize("iterations", [40, 5000])
def test_a_run_that_was_cancelled_early_replaces_nothing(
    extension, worker, tmp_path, head, iterations
):
    """Catches the gray fog of a few iterations in the place of a good avatar, in viewport and
    panel; and a run kept back that may replace one."""
    monitor = extension.operators.monitor
    settings = panel()
    show_ball(tmp_path / "good.npz", order=1)
    shown = settings.splats
    count = len(settings.splats.data.vertices)
    worker.report(Progress(0.01, "Starting up", figures=lambda: {"iteration": 2.0}))
    write_ball_avatar(worker.folder / "preview.npz")
    for _ in range(20):
        monitor.tick()
    assert len(shown.data.vertices) == count
    avatar = end(worker, iterations, cancel=True)
    tick_until(monitor, lambda: settings.result_shown)
    error = state_of(Kind.TRAINING).error
    assert splat_objects() == [shown]
    is_kept = iterations < 300
    assert (len(shown.data.vertices) == count) == is_kept
    assert settings.avatar == str(tmp_path / "good.npz" if is_kept else avatar)
    assert ("was cancelled after 40 iterations" in error) == is_kept
    assert ("Show Avatar shows the new one" in error) == is_kept


def identifiers(modifier):
    names = splat_nodes.DISPLAY, splat_nodes.SIZE, splat_nodes.SELECTED_ONLY
    return {name: input_identifier(modifier, name) for name in names}


def test_show_avatar_again_changes_the_object(head, tmp_path):
    """Catches splats that stack, lost display choices and keyframes, keyframes of one input on
    another, and the neutral mesh or attributes of the avatar before."""
    first = show_ball(tmp_path / "a.npz")
    shown = panel().splats
    settings = panel()
    modifier = splat_modifier(shown)
    ops.choose_display(display=splat_nodes.POINTS)
    named = identifiers(modifier)
    for name, value in ((splat_nodes.SIZE, 0.5), (splat_nodes.SELECTED_ONLY, True)):
        set_input(shown, name, value)
        owner, prop = modifier_input_owner(modifier, named[name])
        owner.keyframe_insert(prop, frame=1)
    shown.location = (0.5, 0, 0)
    shown.keyframe_insert("location", frame=1)
    shown.name = "mine"
    shown.hide_set(True)
    objects = len(bpy.data.objects)
    meshes = len(bpy.data.meshes)
    moved = first.neutral + np.float32(0.01)
    second = show_ball(tmp_path / "b.npz", neutral=moved, sh_degree=0)
    assert (settings.splats, splat_objects()) == (shown, [shown])
    assert (len(bpy.data.objects), len(bpy.data.meshes)) == (objects, meshes)
    assert (shown.name, shown.visible_get(), shown.location.x) == ("mine", True, 0.5)
    renamed = identifiers(modifier)
    assert renamed[splat_nodes.SELECTED_ONLY] != named[splat_nodes.SELECTED_ONLY]
    values = {name: modifier_input(modifier, renamed[name]) for name in renamed}
    assert values[splat_nodes.DISPLAY] == splat_nodes.POINTS
    assert (values[splat_nodes.SIZE], values[splat_nodes.SELECTED_ONLY]) == (0.5, True)
    curves = shown.animation_data.action.layers[0].strips[0].channelbags[0].fcurves
    animated = set(re.findall(r"Socket_\d+", " ".join(curve.data_path for curve in curves)))
    assert animated == {renamed[splat_nodes.SIZE], renamed[splat_nodes.SELECTED_ONLY]}
    neutral = get_input(shown, splat_nodes.NEUTRAL).data
    assert np.allclose([vertex.co for vertex in neutral.vertices], moved, atol=1e-6)
    assert "stga_sh_1" not in shown.data.attributes
    shown.animation_data_clear()
    shown.location = (0, 0, 0)
    set_input(shown, splat_nodes.SIZE, 1.0)
    set_input(shown, splat_nodes.SELECTED_ONLY, False)
    bpy.context.view_layer.update()
    expected = expected_world(second, evaluated_vertices(head)).xyz
    np.testing.assert_allclose(evaluated_splats(shown)[0], expected, atol=1e-5)


def test_a_world_is_shown_in_the_scene_of_its_training(extension, worker, head):
    """Catches splats in the scene that a window shows meanwhile."""
    monitor = extension.operators.monitor
    scene = bpy.context.scene
    other = bpy.data.scenes.new("other")
    avatar = end(worker)
    write_ply(worker.run / "world.ply", read_avatar(avatar).splats)
    with bpy.context.temp_override(scene=other):
        tick_until(monitor, lambda: scene.stga.result_shown)
    assert not other.objects
    (world,) = [thing for thing in scene.objects if tags.WORLD in thing]
    assert not world.visible_get()


def saved_head(folder):
    """A file with a head and its splats, whose run lies beside it."""
    write_ball_run(folder / "run")
    save(folder / "head.blend")
    ops.show_avatar(filepath="//run/avatar.npz")
    bpy.ops.wm.save_mainfile()
    return folder / "head.blend"


def bring_head(file, how):
    name = panel().head.parent.name
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bring(file, how, name)


@pytest.mark.parametrize("how", ["append", "link", "instance"])
def test_what_is_brought_into_another_file_is_shown_alike(extension, head, tmp_path, how):
    """Catches gray heads, bones and cameras over appended, linked or instanced splats, and a path
    to nowhere."""
    file = saved_head(tmp_path)
    bring_head(file, how)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    drawn = {each.object.original for each in depsgraph.object_instances}
    assert not [each.name for each in drawn if each.type == "MESH" and tags.CONVENTION not in each]
    if how == "instance":
        return
    visible = bpy.context.visible_objects
    assert [tags.CONVENTION in each for each in visible if each.type != "EMPTY"] == [True]
    settings = panel()
    assert settings.head.name.endswith(" head")
    assert Path(bpy.path.abspath(settings.avatar)) == tmp_path / "run/avatar.npz"
    assert not np.array_equal(mesh_at(1), mesh_vertices(settings.head.data))
    ops.export_avatar(filepath=tmp_path / "x.ply", format="ply")
    (tmp_path / "shots").mkdir()
    save(tmp_path / "shots/shot.blend")
    if how == "append":
        bring_head(tmp_path / "shots/shot.blend", "append")
        settings = panel()
    assert Path(bpy.path.abspath(settings.avatar)) == tmp_path / "run/avatar.npz"


def test_heads_of_files_from_before_are_hidden_as_well(extension, head, tmp_path):
    """Catches a gray head from a file in which only a view layer hides it."""
    file = saved_head(tmp_path)
    neutral = get_input(panel().splats, splat_nodes.NEUTRAL)
    head.hide_viewport = False
    neutral.hide_viewport = neutral.hide_render = False
    head.hide_set(True)
    bpy.ops.wm.save_mainfile()
    bring_head(file, "append")
    drawn = [each for each in bpy.context.visible_objects if each.type == "MESH"]
    assert [tags.CONVENTION in each for each in drawn] == [True]


def test_a_file_says_what_is_missing_without_the_extension(extension, head, tmp_path):
    """Catches a file that shows nothing where the avatar was, and a note where it is drawn."""
    show_ball(tmp_path / "avatar.npz")
    names = set(bpy.data.objects.keys())
    file = str(tmp_path / "head.blend")
    save(file, copy=True)
    assert set(bpy.data.objects.keys()) == names
    with bpy.data.libraries.load(file) as (stored, taken):
        (note,) = set(stored.objects) - names
        taken.objects = [note]
    (text,) = taken.objects
    assert "STGA" in text.data.body
    assert text.hide_render
    open_file(file)
    assert set(bpy.data.objects.keys()) == names
    assert not [each for each in bpy.data.curves if "STGA" in each.name]


def test_what_the_engine_leaves_out_is_said(extension, head, tmp_path):
    """Catches F12 by the engine that drops meshes without a warning, a button that leaves it at
    that, and passes and shadows of a set that stay on for another engine."""
    show_ball(tmp_path / "avatar.npz")
    scene = bpy.context.scene
    hint = extension.ui.show_panel.left_out_hint
    scene.render.engine = extension.ui.show_panel.ENGINE
    assert hint(scene) is None
    bpy.ops.mesh.primitive_cube_add()
    assert "leaves out" in hint(scene)
    layer = scene.view_layers[0]
    before = layer.use_pass_z, throws_shadow(panel().splats)
    ops.choose_set(shown="SHOWN")
    assert hint(scene) is None
    assert (layer.use_pass_z, throws_shadow(panel().splats)) == (True, True)
    scene.render.engine = "CYCLES"
    assert "leave out the set" in hint(scene)
    scene.render.engine = extension.ui.show_panel.ENGINE
    ops.choose_set(shown="LEFT_OUT")
    assert (layer.use_pass_z, throws_shadow(panel().splats)) == before
    bpy.context.object.hide_render = True
    assert hint(scene) is None
