"""A newcomer's first hour: messages that can be read, a .blend file that knows its run."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from light.scenes import lit_avatar

from stga_addon.scene import tags
from stga_addon.scene.arrays import triangle_mesh
from stga_addon.scene.compat import enable_nodes
from stga_addon.scene.display.splat_nodes import POINTS
from stga_addon.scene.display.splat_object import display_mode, show_avatar

from .session import open_file, ops, panel, reopen, save, shown_layers, viewport
from .test_operators import show_ball, write_ball_run
from .test_panel import draw

LACKS = (
    "/opt/blender/5.2/python/bin/python3.13 (Python 3.13.2) lacks torch, numba, scipy, pillow. "
    "Install the complete "
    "edition of the add-on, or choose a Python that has them in its preferences or by STGA_PYTHON"
)
BUTTONS = {
    LACKS: "Choose a Python",
    "run folder: //run is relative to the .blend file, which has not been saved yet": "Save the "
    "File",
    "/captures/anna: was tracked with FLAME and needs a FLAME model": "Choose It",
}


@pytest.mark.parametrize("sentence", BUTTONS)
def test_long_errors_are_in_the_panel(extension, head, monkeypatch, sentence):
    """Catches a remedy that the status bar cuts off, and an error that stays after a success."""
    monkeypatch.setattr(extension.ui.train_panel, "has_training_python", lambda context: False)
    common = extension.operators.common
    reports = []

    def fail(self, context):
        raise extension.stga_addon.errors.StgaError(sentence)

    class Operator(common.Action):
        report = staticmethod(lambda kind, text: reports.append((kind, text)))
        run = fail

    assert Operator().execute(bpy.context) == {"CANCELLED"}
    assert reports == [({"ERROR"}, sentence)], "without a window there is no panel"
    brief = common.short_sentence(sentence)
    assert len(brief) <= 90
    assert "/" not in brief.replace("//", "")
    texts = draw(extension, "next_step")
    assert sentence in texts
    assert BUTTONS[sentence] in texts
    Operator.run = lambda self, context: None
    assert Operator().execute(bpy.context) == {"FINISHED"}
    assert sentence not in draw(extension, "next_step")


def test_next_step_tells_what_is_so_now(extension, head, monkeypatch, tmp_path):
    """Catches a file that is said not to be saved after it was, and, during a training, advice for
    after it."""
    manager = bpy.context.window_manager
    ops.show_avatar(filepath=write_ball_run(tmp_path / "run") / "avatar.npz")
    for sentence, stays in (("It has not been saved yet", False), ("Another", True)):
        manager.stga_message = sentence
        save(tmp_path / "head.blend")
        assert (sentence in draw(extension, "next_step")) == stays
    assert any("Orbit" in text for text in draw(extension, "next_step"))
    request = extension.operators.monitor.RequestState
    is_training = property(lambda state: state.kind == "training")
    monkeypatch.setattr(request, "is_running", is_training)
    texts = draw(extension, "next_step")
    assert any("Training: the splats improve" in text for text in texts)
    assert not any("Orbit" in text for text in texts)


def test_a_run_made_after_its_head(extension, head, tmp_path):
    """Catches no Train More after Avatar from Video, whose head is there before its run."""
    settings = panel()
    settings.run_folder = str(write_ball_run(tmp_path / "run"))
    results = extension.operators.results
    making = extension.operators.monitor.RequestState(results.Kind.AVATAR, tmp_path, tmp_path)
    results.store_avatar(bpy.context.scene, making, tmp_path / "run/avatar.npz")
    assert settings.holds_run


def test_a_file_made_without_the_panel(extension, head, tmp_path):
    """Catches demo.blend with an empty panel, and a chosen head replaced at loading."""
    ops.show_avatar(filepath=write_ball_run(tmp_path / "run") / "avatar.npz")
    settings = panel()
    name = head.name
    path = str(tmp_path / "demo.blend")
    settings.splats[tags.AVATAR] = "//run/avatar.npz"  # as older versions stored it
    for each in (tags.AVATAR, tags.RUN):
        head.pop(each, None)
    for each in ("head", "splats"):
        settings.property_unset(each)
    reopen(path)
    assert panel().run_folder == "//run"
    assert panel().head.name == name
    other = panel().head = bpy.data.objects.new("other", None)
    bpy.context.scene.collection.objects.link(other)
    bpy.ops.wm.save_mainfile()
    open_file(path)
    assert panel().head.name == "other"


def test_the_chosen_row_is_that_of_the_frame(head):
    """Catches a highlight that stays when another row, or the timeline, is clicked."""
    ops.select(threshold=0.0005)
    scene = bpy.context.scene
    for row, frame in enumerate(settings_row.frame for settings_row in scene.stga.selected_frames):
        scene.stga.selected_row = row
        assert scene.frame_current == frame
    scene.frame_set(scene.stga.selected_frames[0].frame)
    assert scene.stga.selected_row == 0
    scene.frame_set(999)
    assert scene.stga.selected_row == -1


def test_what_the_small_edition_begins_with(extension, monkeypatch):
    """Catches an edition without demo and Python that does not say what to click instead."""
    for has_demo, has_python in ((False, False), (True, True)):
        poll = staticmethod(lambda context, has_demo=has_demo: has_demo)
        monkeypatch.setattr(extension.ui.next_step.OpenDemo, "poll", poll)
        for each in (extension.ui.next_step, extension.ui.train_panel):
            there = lambda context, has_python=has_python: has_python  # noqa: E731
            monkeypatch.setattr(each, "has_training_python", there)
        said = " ".join(draw(extension, "next_step"))
        assert ("no demo" in said, "Open Demo Capture" in said) == (not has_demo, has_demo)
        assert ("first. " in said, "Choose a Python " in said) == (not has_python, not has_python)


def test_what_an_image_leaves_out_is_said_in_a_small_window(extension, monkeypatch):
    """Catches a sentence that the window of a small image cuts off."""
    said = []
    menu = SimpleNamespace(layout=SimpleNamespace(label=lambda text: said.append(text)))
    manager = SimpleNamespace(
        windows=[SimpleNamespace(width=320)], popup_menu=lambda draw, **_: draw(menu, None)
    )
    context = SimpleNamespace(
        window_manager=manager,
        temp_override=lambda **_: nullcontext(),
        preferences=SimpleNamespace(system=SimpleNamespace(ui_scale=1.0)),
    )
    monkeypatch.setattr(extension.ui.show_panel, "bpy", SimpleNamespace(context=context))
    hint = "Scene lights count in As Trained only; Relight Frame stores them for other engines"
    extension.ui.show_panel._pop_up(hint)
    assert " ".join(said) == hint
    assert max(map(len, said)) * 7 < 320


def test_exports_propose_the_name_of_the_head(extension, head, tmp_path):
    """Catches "Untitled" as the name of a first video."""
    helper = extension.operators.common.FileExport

    class Video(helper):
        filepath = ""
        filename_ext = ".mp4"

    asked = []
    manager = SimpleNamespace(fileselect_add=asked.append)
    context = SimpleNamespace(scene=bpy.context.scene, window_manager=manager, blend_data=bpy.data)
    head.parent.name = "anna 1/2"
    panel().run_folder = str(tmp_path / "run") + "/"
    Video().invoke(context, None)
    assert [each.filepath for each in asked] == [str(tmp_path / "anna_1_2.mp4")]
    save(tmp_path / "saved.blend")
    Video().invoke(context, None)
    assert asked[1].filepath == str(tmp_path / "saved.mp4")


def test_a_display_is_chosen_with_a_shading_that_shows_it(extension, head, tmp_path):
    """Catches gray splats in Solid mode after another display was chosen."""
    show_ball(tmp_path / "avatar.npz")
    window, area = viewport()
    shading = area.spaces.active.shading
    shading.type = "SOLID"
    with bpy.context.temp_override(window=window, area=area):
        ops.choose_display(display=POINTS)
    assert (display_mode(panel().splats), shading.type) == (POINTS, "MATERIAL")


def test_the_first_click_on_scene_light_is_as_bright_as_trained(extension):
    """Catches an avatar washed out by the world, and an exposure that a click takes back."""
    avatar = lit_avatar()
    scene = bpy.context.scene
    mesh = bpy.data.objects.new("head", triangle_mesh("head", avatar.neutral, avatar.faces))
    scene.collection.objects.link(mesh)
    bpy.context.view_layer.update()
    scene.stga.splats = show_avatar(avatar, mesh)
    scene.world = bpy.data.worlds.new("world")
    enable_nodes(scene.world).nodes["Background"].inputs["Strength"].default_value = 40.0
    lighting = scene.stga_lighting
    lighting.mode = "scene"
    (layer,) = shown_layers()
    eye = np.array((0.0, 0.0, 1.0))
    relit = layer.relit
    recorded = replace(relit.lighting, mode="recorded")
    means = [
        relit.relighter.radiance(relit.mesh, eye, each).mean()
        for each in (relit.lighting, recorded)
    ]
    assert lighting.exposure < -1
    assert means[0] == pytest.approx(means[1], rel=0.05)
    lighting.exposure = 1.5
    lighting.mode = "recorded"
    lighting.mode = "scene"
    assert lighting.exposure == 1.5


def test_appended_and_deleted_heads(head, tmp_path):
    """Catches a panel that does not know an appended head, or works on one that is deleted."""
    file = str(tmp_path / "head.blend")
    name = head.name
    save(file)
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.append(directory=f"{file}/Object/", filename=name)
    scene = bpy.context.scene
    assert scene.stga.head == bpy.data.objects[name]
    for collection in scene.stga.head.users_collection:
        collection.objects.unlink(scene.stga.head)
    bpy.context.view_layer.update()
    assert scene.stga.head is None
