"""The operators, called as a script calls them, from the checkout registered as an extension."""

import re
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from capture.factory import ball, write_flame_capture, write_mesh_capture
from export.web.web_data import read_web_data
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.avatar.embedding import to_world
from stga_addon.avatar.file import Avatar, read_avatar, write_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.capture.open import open_capture
from stga_addon.capture.selection import SelectionOptions, select_capture
from stga_addon.development.demo.in_blender import evaluated_splats
from stga_addon.export.formats import export_avatar
from stga_addon.export.ply import read_ply, write_ply
from stga_addon.jobs.track import Track
from stga_addon.scene.vertex_groups import read_selection

from .captures import closure, mesh_at
from .session import failure, ops, panel, reopen

pytestmark = pytest.mark.usefixtures("extension")

SET_BY_PANEL = {
    "track_footage": "footage model avatar directory cameras focal start stop step mattes "
    "matte_folder",
    "view_footage": "",
    "train": "directory minutes resume strategy preset device adapter effects",
    "refine": "directory group seconds growth device adapter",
    "extend": "directory take seconds device adapter",
    "apply_motion": "filter_glob",
    "show_avatar": "hide_head filter_glob",
    "export_avatar": "format filter_glob check_existing motion_only filmed_only",
    "export_cameras": "selected_only filter_glob check_existing",
    "heat_map": "",
    "copy_report": "",
}
"""Operator -> properties that its button in the panel sets, or that a user chooses in its file
dialog."""


@pytest.fixture
def mesh_capture(tmp_path):
    return write_mesh_capture(tmp_path / "capture")


@pytest.fixture
def shown(mesh_capture, tmp_path):
    """A mesh capture whose head is in the scene with the avatar of avatar.npz."""
    ops.import_capture(directory=mesh_capture)
    avatar = show_ball(tmp_path / "avatar.npz")
    return open_capture(mesh_capture), avatar


def write_ball_avatar(path, neutral=None, **options):
    """An avatar of the captures' ball, or of a mesh of its triangles, off the lattice."""
    vertices, faces = ball()
    vertices = vertices if neutral is None else neutral
    faces = faces.astype(np.int32)
    splats = lattice_splats(vertices, faces, **{"sh_degree": 1, **options})
    off = np.random.default_rng(0).normal(0, 0.002, splats.xyz.shape).astype(np.float32)
    splats = replace(splats, xyz=splats.xyz + off)
    avatar = Avatar(splats, "stga", vertices.astype(np.float32), faces)
    write_avatar(path, avatar)
    return avatar


def write_ball_run(folder):
    """A run's folder with such an avatar."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "run.json").write_text("{}")
    write_ball_avatar(folder / "avatar.npz")
    return folder


def show_ball(path, neutral=None, **options):
    """Write such an avatar and show it."""
    avatar = write_ball_avatar(path, neutral, **options)
    ops.show_avatar(filepath=path)
    return avatar


def expected_world(avatar, vertices):
    return to_world(avatar.splats, avatar.frames(vertices))


def operators():
    # bpy.ops answers for any name; only a registered operator has a type
    return {name for name in dir(bpy.types) if name.startswith("STGA_OT_")}


def test_registration_is_all_or_nothing(extension, monkeypatch):
    """Catches what stays behind after disabling or a failed enabling."""
    menu = len(bpy.types.TOPBAR_MT_file_import.draw._draw_funcs)
    all_of_them = operators()
    assert len(all_of_them) > 40
    extension.unregister()
    monkeypatch.setattr(extension.operators.command_line, "register", lambda at_end: 1 / 0)
    for _ in range(2):
        assert not operators()
        assert not hasattr(bpy.types.Scene, "stga")
        assert not hasattr(bpy.types, "STGA_PT_capture")
        assert len(bpy.types.TOPBAR_MT_file_import.draw._draw_funcs) == menu - 1
        with pytest.raises(ZeroDivisionError):
            extension.register()
    monkeypatch.undo()
    extension.register()
    assert operators() == all_of_them


def test_every_operator_explains_itself():
    """Catches operators and properties without the tooltip that is their only manual, and a
    script's `resume` that Blender remembers for the next click: what tells it not to is checked."""
    for name in operators():
        function = name.removeprefix("STGA_OT_")
        kind = getattr(ops, function).get_rna_type()
        assert kind.description not in ("", "(undocumented operator)"), name
        properties = [prop for prop in kind.properties if prop.identifier != "rna_type"]
        for prop in properties:
            assert prop.is_hidden or prop.description, (name, prop.identifier)
        if function in SET_BY_PANEL:
            remembered = {prop.identifier for prop in properties if not prop.is_skip_save}
            assert remembered <= {*SET_BY_PANEL[function].split()}, name


def test_options_are_those_of_the_request(extension):
    """Catches a limit, default or choice other than the command line's, and 0 taken for a value."""
    shown = ops.track_footage.get_rna_type().properties
    for name in ("focal", "start", "stop", "step"):
        field = Track.__dataclass_fields__[name]
        least = 0 if field.default is None else field.metadata["minimum"]
        assert (shown[name].hard_min, shown[name].default) == (least, field.default or 0), name
        assert "default" not in shown[name].description
    assert shown["stop"].description == "Timestep to stop before; 0: all"
    strategies = ops.train.get_rna_type().properties["strategy"].enum_items
    names = {"global", "selective", "gaussian-avatars"}
    assert {item.identifier for item in strategies} == names
    given = {"focal": 0.0, "start": 0, "stop": 0, "step": 2, "model": "", "cameras": "/a.json"}
    read = extension.operators.common.given_values(SimpleNamespace(**given), Track, *given)
    assert read == {"start": 0, "step": 2, "cameras": Path("/a.json")}


@pytest.mark.parametrize("layout", ["mesh", "flame"])
def test_from_import_to_show(tmp_path, layout):
    """Catches a chain that breaks between two operators, each of which works on what the one before
    left in the scene, or in the saved file; and splats that stand still once the head's mesh, which
    keys or bones move, is hidden."""
    if layout == "mesh":
        folder = write_mesh_capture(tmp_path / "capture")
        model = None
    else:
        folder, model = write_flame_capture(tmp_path / "capture")
    capture = open_capture(folder, model)
    ops.import_capture(directory=folder, flame=model or "")
    scene = bpy.context.scene
    assert (scene.frame_start, scene.frame_end) == (0, 3)
    assert (scene.render.resolution_x, scene.render.resolution_y) == (40, 60)
    ops.select(threshold=0.0015)
    rule = select_capture(capture, SelectionOptions(threshold=0.0015))
    written = read_selection(scene.stga.head)
    assert rule[3].any()
    assert not rule[1].any() or layout == "flame"
    for timestep, selected in rule.items():
        expected = closure(selected, capture.faces) & selected.any()
        assert_array_equal(written[timestep], expected)
    avatar = show_ball(tmp_path / "avatar.npz")
    reopen(tmp_path / "head.blend")
    scene = bpy.context.scene
    assert scene.stga.head.hide_render
    assert not scene.stga.head.visible_get()
    for timestep in (3, 0, 1):
        mesh = capture.mesh(timestep)
        assert_allclose(mesh_at(timestep), mesh, atol=2e-6)
        xyz, _, _ = evaluated_splats(scene.stga.splats)
        assert_allclose(xyz, expected_world(avatar, mesh).xyz, atol=1e-5)


def test_exports(shown, tmp_path):
    """Catches formats Blender cannot write, other frames or rates, and a head on its back."""
    usd = pytest.importorskip("pxr.Usd", reason="the package usd-core is not installed")
    capture, avatar = shown
    bpy.context.scene.render.fps = 30
    bpy.context.scene.frame_set(3)
    formats = {
        "one.ply": "ply",
        "many": "ply-sequence",
        "a.usdz": "usd",
        "a.glb": "gltf",
        "a.spz": "spz",
    }
    for name, format in formats.items():
        ops.export_avatar(filepath=tmp_path / name, format=format)
        assert (tmp_path / name).stat().st_size > 0
    assert bpy.context.scene.frame_current == 3
    stage = usd.Stage.Open(str(tmp_path / "a.usdz"))
    assert stage.GetTimeCodesPerSecond() == 30
    positions = stage.GetPrimAtPath("/Avatar/Splats").GetAttribute("positions")
    assert positions.GetTimeSamples() == [0, 1, 2, 3]
    for frame in capture.timesteps:
        expected = expected_world(avatar, capture.mesh(frame)).xyz
        assert_allclose(positions.Get(frame), expected, atol=1e-5)
        many = read_ply(tmp_path / f"many/{frame:05d}.ply").xyz
        assert_allclose(many, expected, atol=1e-5)
    assert_array_equal(read_ply(tmp_path / "one.ply").xyz, many)
    with failure("not tracked with FLAME"):
        ops.export_avatar(filepath=tmp_path / "pair", format="gaussian-avatars")
    one = {"filepath": tmp_path / "one.ply", "format": "ply", "filmed_only": True}
    with failure("does not state what was filmed"):
        ops.export_avatar(**one)
    unseen = np.arange(len(avatar.faces)) % 2 == 0
    path = tmp_path / "avatar.npz"
    write_avatar(path, replace(read_avatar(path), regions={"unseen": unseen}))
    ops.export_avatar(**one)
    kept = expected.astype(np.float32)[~unseen[avatar.splats.face]]
    assert_allclose(read_ply(tmp_path / "one.ply").xyz, kept, atol=1e-5)
    bpy.context.scene.frame_start = 1
    ops.export_avatar(filepath=tmp_path / "a.glb", format="web")
    header, arrays = read_web_data((tmp_path / "a.glb").read_bytes())
    assert len(arrays["translation"]) == 3
    centers = [capture.mesh(timestep).mean(0) for timestep in (1, 3)]
    assert_allclose(arrays["translation"][[0, 2]], centers, atol=1e-5)
    up = np.array(panel().head.matrix_world.to_3x3()) @ header["up"]
    assert_allclose(up, [0, 0, 1], atol=1e-5)


@pytest.mark.parametrize("export", [ops.export_avatar, ops.export_splats])
def test_usd_is_written_by_the_python_that_trains(shown, extension, tmp_path, monkeypatch, export):
    """Catches USD files that a Blender without USD refuses although the Python that trains has
    it."""
    pytest.importorskip("pxr.Usd", reason="the package usd-core is not installed")
    export(filepath=tmp_path / "here.usdc", format="usd")
    for module in (extension.operators.export, extension.stga_addon.export.usd):
        monkeypatch.setattr(module, "find_usd", lambda: None)
    with failure("USD files need the package usd-core"):
        export(filepath=tmp_path / "there.usdc", format="usd")
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    monkeypatch.setenv("STGA_PYTHON", str(python))
    export(filepath=tmp_path / "there.usdc", format="usd")
    assert (tmp_path / "there.usdc").read_bytes() == (tmp_path / "here.usdc").read_bytes()


class RangeExport:
    """A range that is exported as the dialog does, event by event."""

    def __init__(self, extension, write, frames):
        operator = extension.operators.export.ExportAvatar
        objects = extension.stga_addon.scene.objects
        view = objects.SceneView(bpy.context)
        head = objects.Identity(panel().head)
        self.said: list[str] = []
        self.dialog = SimpleNamespace(others="", inform=self.said.append)
        self.dialog.report = self.dialog.notify = lambda kind, text: self.said.append(text)
        self._modal = operator.modal

        def read():
            return extension.operators.export.head_vertices(head.get())

        steps = operator.export(self.dialog, view, read, Path(), frames, write)
        self.dialog._steps = extension.operators.common.Steps(steps, 1.0)

    def event(self, kind="TIMER"):
        value = "PRESS" if kind == "ESC" else "NOTHING"
        event = SimpleNamespace(type=kind, value=value)
        (result,) = self._modal(self.dialog, bpy.context, event)
        time.sleep(0.001)
        return result

    def until(self, is_over=lambda: False):
        """Timer events until the export ends, or `is_over`."""
        result = "RUNNING_MODAL"
        while result == "RUNNING_MODAL" and not is_over():
            result = self.event()
        return result


def export_threads():
    return [each for each in threading.enumerate() if each.name.startswith("stga export")]


def wait_for_threads():
    """Threads of exports end by themselves, soon."""
    deadline = time.monotonic() + 20
    while export_threads() and time.monotonic() < deadline:
        time.sleep(0.005)
    assert not export_threads()


def frames_to(folder, avatar, events=None):
    """A write of a sequence into a folder, which notes the frames that it has been given."""

    def write(meshes):
        def noted():
            for number, mesh in meshes:
                if events is not None:
                    events.append(f"frame {number}")
                yield number, mesh

        return export_avatar(folder, avatar, "ply-sequence", noted())

    return write


def test_a_range_is_exported_step_by_step(extension, shown, tmp_path, monkeypatch):
    """Catches another export than a script's, traces of a cancelled one, a silent thread, and
    frames that are set under a render which begins meanwhile."""
    capture, avatar = shown
    scene = bpy.context.scene
    scene.frame_set(1)

    def fail(meshes):
        next(iter(meshes))
        raise extension.stga_addon.errors.StgaError("no room")

    rendering = [False]
    monkeypatch.setattr(extension.operators.export, "is_rendering", lambda: rendering[0])
    whole = RangeExport(extension, frames_to(tmp_path / "whole", avatar), range(4))
    assert whole.event() == "RUNNING_MODAL"
    rendering[0] = True
    for frame in (30, 31):  # as the render sets them
        scene.frame_set(frame)
        assert whole.event() == "RUNNING_MODAL"
        assert scene.frame_current == frame
    rendering[0] = False
    assert whole.until() == "FINISHED"
    files = sorted((tmp_path / "whole").glob("*.ply"))
    assert [path.name for path in files] == [f"{frame:05d}.ply" for frame in range(4)]
    expected = expected_world(avatar, capture.mesh(3)).xyz
    assert_allclose(read_ply(files[3]).xyz, expected, atol=1e-5)
    given = []
    cut = RangeExport(extension, frames_to(tmp_path / "cut", avatar, given), range(40))
    assert cut.until(lambda: "frame 2" in given) == "RUNNING_MODAL"
    result = cut.event("ESC")
    assert (result if result != "RUNNING_MODAL" else cut.until()) == "CANCELLED"
    assert re.fullmatch(r"Export cancelled after \d+ of 40 frames", cut.said[-1])
    assert not (tmp_path / "cut").exists()
    failed = RangeExport(extension, fail, range(50))
    assert (failed.until(), failed.said) == ("CANCELLED", ["no room"])
    assert bpy.context.scene.frame_current == 1
    wait_for_threads()


@pytest.mark.parametrize("end", ["no head", "bug", "new file", "disabled"])
def test_an_export_always_ends(extension, shown, tmp_path, monkeypatch, end):
    """Catches a thread that keeps Blender from quitting, and partial files, where an export ends
    early: its head is deleted, in another window too, an unexpected error, a file that is opened,
    or the extension disabled; and an error told as a traceback."""
    given = []
    running = RangeExport(extension, frames_to(tmp_path / "out", shown[1], given), range(40))
    assert running.until(lambda: "frame 2" in given) == "RUNNING_MODAL"
    if end == "no head":
        bpy.data.objects.remove(panel().head)
        assert running.until() == "CANCELLED"
        assert running.said[-1].endswith("head: was removed meanwhile")
    elif end == "bug":
        monkeypatch.setattr(extension.operators.export, "head_vertices", lambda head: 1 / 0)
        assert running.until() == "CANCELLED"
        assert "unexpected error (ZeroDivisionError" in running.said[-1]
    elif end == "new file":  # before which Blender cancels what is running in the window
        extension.operators.export.ExportAvatar.cancel(running.dialog, bpy.context)
        bpy.ops.wm.read_homefile(use_empty=True)
    else:
        extension.unregister()
        extension.register()
    wait_for_threads()
    assert not (tmp_path / "out").exists()
    assert not extension.operators.common._begun


def test_undo_and_new_names_do_not_end_an_export(extension, shown, tmp_path):
    """Catches references to scene and head, which undo in a second window makes invalid."""
    capture, avatar = shown
    scene = bpy.context.scene
    given = []
    bpy.ops.ed.undo_push(message="before")
    scene.stga.head.location.x = 1
    bpy.ops.ed.undo_push(message="moved")
    running = RangeExport(extension, frames_to(tmp_path / "out", avatar, given), range(4))
    running.until(lambda: "frame 1" in given)
    bpy.ops.ed.undo()
    bpy.context.scene.name = "renamed"
    panel().head.name = "Anna"
    assert (running.until(), running.said) == ("FINISHED", ["Exported to ."])
    expected = expected_world(avatar, capture.mesh(3)).xyz
    assert_allclose(read_ply(tmp_path / "out/00003.ply").xyz, expected, atol=1e-5)


@pytest.mark.parametrize("is_named", [False, True])
def test_escape_while_an_export_is_written(extension, shown, tmp_path, is_named):
    """Catches Esc after the last frame that freezes Blender until all is written, and exports all
    the same; where the file is there already, that is said."""
    reached = threading.Event()
    goes_on = threading.Event()
    path = tmp_path / "out.bin"

    def write(meshes):
        list(meshes)
        with replacing(path) as partial:
            partial.write_bytes(b"all")
            if not is_named:
                reached.set()
                assert goes_on.wait(20)
        reached.set()
        assert goes_on.wait(20)

    replacing = extension.stga_addon.files.replacing
    running = RangeExport(extension, write, range(2))
    assert running.until(reached.is_set) == "RUNNING_MODAL"
    assert running.event("ESC") == "RUNNING_MODAL"  # and not only once all is written
    assert running.event("MOUSEMOVE") == "PASS_THROUGH"
    assert running.event("ESC") == "RUNNING_MODAL"
    goes_on.set()
    assert running.until() == ("FINISHED" if is_named else "CANCELLED")
    assert ("Exported" in running.said[-1], path.exists()) == (is_named, is_named)
    assert is_named == ("complete when Esc was pressed" in running.said[-1])
    assert not list(tmp_path.glob(".*partial"))


def test_import_ply(tmp_path):
    """Catches a scan that lies on its back: the file's up axis must point along Blender's z."""
    vertices, faces = ball()
    splats = lattice_splats(vertices, faces.astype(np.int32), order=0)
    splats = replace(splats, face=np.zeros(len(faces), np.int32))
    write_ply(tmp_path / "scan.ply", splats)
    for up, axis in (("Y", (0, 1, 0)), ("-Y", (0, -1, 0)), ("Z", (0, 0, 1))):
        ops.import_ply(filepath=tmp_path / "scan.ply", up=up)
        shown = panel().splats
        bpy.context.view_layer.update()
        turned = np.array(shown.matrix_world)[:3, :3] @ axis
        assert_allclose(turned, (0, 0, 1), atol=1e-6)
        assert len(evaluated_splats(shown)[0]) == len(splats)


def test_mistakes_are_sentences(mesh_capture, tmp_path):
    """Catches tracebacks, silence, objects of a failed import, and steps without a head."""
    mesh = mesh_capture / "meshes/00003.obj"
    broken = tmp_path / "broken.ply"
    whole = mesh.read_text()
    mesh.write_text("v 0 0 nan\n")
    broken.write_bytes(b"ply\n")
    for operator, arguments, sentence in (
        ("import_capture", {"directory": f"{tmp_path}/nowhere"}, ".*nowhere: is not a folder"),
        ("import_capture", {}, ".*no path given"),
        ("import_capture", {"directory": "//capture"}, ".*has not been saved yet"),
        ("import_capture", {"directory": mesh_capture}, r".*00003\.obj"),
        ("import_ply", {"filepath": broken}, ".*broken.ply: is not a PLY file"),
    ):
        with failure(f"^Error: {sentence}"):
            getattr(ops, operator)(**arguments)
    assert not bpy.data.objects
    for name in ("select", "train", "show_avatar", "export_avatar", "heat_map", "apply_motion"):
        with failure("Import a capture first"):
            getattr(ops, name)()
    mesh.write_text(whole)
    ops.import_capture(directory=mesh_capture)
    mesh_capture.rename(tmp_path / "elsewhere")
    with failure(r"its capture is no longer at .*capture; Import Capture"):
        ops.select()
