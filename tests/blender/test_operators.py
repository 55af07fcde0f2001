"""The operators, called as a script calls them, from the checkout registered as an extension."""

import sys
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from capture.factory import ball, write_flame_capture, write_mesh_capture  # noqa: E402
from export.web.web_data import read_web_data  # noqa: E402

from stga_addon.avatar.embedding import face_frames, to_world  # noqa: E402
from stga_addon.avatar.file import Avatar, read_avatar, write_avatar  # noqa: E402
from stga_addon.avatar.lattice import lattice_splats  # noqa: E402
from stga_addon.avatar.splats import Splats  # noqa: E402
from stga_addon.capture.model import Capture  # noqa: E402
from stga_addon.capture.open import open_capture  # noqa: E402
from stga_addon.errors import StgaError  # noqa: E402
from stga_addon.export.formats import export_avatar  # noqa: E402
from stga_addon.export.ply import read_ply, read_vertices, write_ply  # noqa: E402
from stga_addon.jobs.track import Track  # noqa: E402
from stga_addon.scene.arrays import evaluated_vertices  # noqa: E402
from stga_addon.scene.display import splat_nodes  # noqa: E402
from stga_addon.scene.display.splat_nodes import POINTS  # noqa: E402
from stga_addon.scene.display.splat_object import evaluated_splats, set_input  # noqa: E402
from stga_addon.scene.vertex_groups import read_selection  # noqa: E402
from stga_addon.selection import SelectionOptions, select_capture  # noqa: E402

from .captures import closure  # noqa: E402

pytestmark = pytest.mark.usefixtures("extension")

OPERATORS = (
    "track_footage", "view_footage", "mark_key", "solve_again", "export_head_model", "open_demo",
    "import_capture", "import_motion", "import_meshes", "select", "toggle_region", "count_selected",
    "heat_map", "analyze_capture", "avatar_from_video", "train", "refine", "extend", "cancel",
    "dismiss", "copy_report", "test_python", "show_avatar", "apply_motion", "standard_view",
    "preview_images", "render_video", "import_ply", "export_avatar", "export_cameras", "open_npz",
)  # fmt: skip


@pytest.fixture
def mesh_capture(tmp_path) -> Path:
    return write_mesh_capture(tmp_path / "capture")


@pytest.fixture
def shown(mesh_capture, tmp_path) -> tuple[Capture, Avatar]:
    """A mesh capture whose head is in the scene, and the avatar of avatar.npz, which is shown on
    it."""
    bpy.ops.stga.import_capture(directory=str(mesh_capture))
    avatar = write_ball_avatar(tmp_path / "avatar.npz")
    assert bpy.ops.stga.show_avatar(filepath=str(tmp_path / "avatar.npz")) == {"FINISHED"}
    return open_capture(mesh_capture), avatar


def assert_follow(capture: Capture, avatar: Avatar, timesteps: Iterable[int]) -> None:
    """The splats in the scene are where the capture's meshes of these timesteps carry them."""
    for timestep in timesteps:
        bpy.context.scene.frame_set(timestep)
        xyz, _, _ = evaluated_splats(bpy.context.scene.stga.splats)
        np.testing.assert_allclose(
            xyz, expected_world(avatar, capture.mesh(timestep)).xyz, atol=1e-5
        )


def registered(name: str) -> bool:
    # bpy.ops answers for any name; only a registered operator has a type
    return hasattr(bpy.types, f"STGA_OT_{name}")


def write_ball_avatar(path: Path, convention: str = "stga") -> Avatar:
    vertices, faces = ball()
    faces = faces.astype(np.int32)
    splats = lattice_splats(vertices, faces, sh_degree=1, convention=convention)
    rng = np.random.default_rng(0)
    splats = replace(
        splats, xyz=splats.xyz + rng.normal(0, 0.002, splats.xyz.shape).astype(np.float32)
    )
    avatar = Avatar(splats, convention, vertices.astype(np.float32), faces)
    write_avatar(path, avatar)
    return avatar


def expected_world(avatar: Avatar, vertices: np.ndarray) -> Splats:
    return to_world(
        avatar.splats, face_frames(vertices, avatar.faces, avatar.neutral, avatar.convention)
    )


def test_register_and_unregister_leave_nothing(extension):
    """Catches classes, menus and properties that stay behind, which the next enabling would trip
    over."""
    menu = len(bpy.types.TOPBAR_MT_file_import.draw._draw_funcs)
    assert all(registered(name) for name in OPERATORS)
    extension.unregister()
    assert not any(registered(name) for name in OPERATORS)
    assert not hasattr(bpy.types.Scene, "stga")
    assert not hasattr(bpy.types, "STGA_PT_capture")
    assert len(bpy.types.TOPBAR_MT_file_import.draw._draw_funcs) == menu - 1
    extension.register()
    assert all(registered(name) for name in OPERATORS)


def test_a_failing_registration_is_rolled_back(extension, monkeypatch):
    """Catches a half-registered extension, which can be neither enabled nor disabled."""
    extension.unregister()
    monkeypatch.setattr(extension.operators.command_line, "register", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        extension.register()
    assert not any(registered(name) for name in OPERATORS)
    assert not hasattr(bpy.types.Scene, "stga")
    monkeypatch.undo()
    extension.register()


def test_every_operator_explains_itself(extension):
    """Catches operators and properties without the tooltip that is their only manual inside
    Blender."""
    for name in OPERATORS:
        kind = getattr(bpy.ops.stga, name).get_rna_type()
        assert kind.description not in ("", "(undocumented operator)"), name
        for prop in kind.properties:
            assert prop.identifier == "rna_type" or prop.is_hidden or prop.description, (
                name,
                prop.identifier,
            )


def test_options_are_those_of_the_request(extension):
    """Catches a limit, default or choice that differs from the command line's, and 0 that is not
    taken for "not given", or is called a value."""
    shown = bpy.ops.stga.track_footage.get_rna_type().properties
    for name in ("focal", "start", "stop", "step"):
        field = Track.__dataclass_fields__[name]
        least = 0 if field.default is None else field.metadata["minimum"]
        assert (shown[name].hard_min, shown[name].default) == (least, field.default or 0), name
        assert "default" not in shown[name].description
    assert shown["stop"].description == "Timestep to stop before; 0: all"
    strategy = bpy.ops.stga.train.get_rna_type().properties["strategy"]
    assert {item.identifier for item in strategy.enum_items} == {
        "global", "selective", "gaussian-avatars",
    }  # fmt: skip
    given = SimpleNamespace(
        focal=0.0, start=0, stop=0, step=2, model="", cameras="/a.json", mattes="none"
    )
    names = ("focal", "start", "stop", "step", "model", "cameras")
    assert extension.operators.options.given_values(given, Track, *names) == {
        "start": 0, "step": 2, "cameras": Path("/a.json"),
    }  # fmt: skip


SET_BY_PANEL = {
    "track_footage": {
        "footage",
        "model",
        "avatar",
        "directory",
        "cameras",
        "focal",
        "start",
        "stop",
        "step",
        "mattes",
        "matte_folder",
    },
    "view_footage": set(),
    "train": {
        "directory",
        "minutes",
        "resume",
        "strategy",
        "preset",
        "device",
        "adapter",
        "effects",
    },
    "refine": {"directory", "group", "seconds", "growth", "device", "adapter"},
    "extend": {"directory", "take", "seconds", "device", "adapter"},
    "apply_motion": {"filter_glob"},
    "show_avatar": {"hide_head", "filter_glob"},
    "export_avatar": {"format", "filter_glob", "check_existing", "motion_only"},
    "export_cameras": {"selected_only", "filter_glob", "check_existing"},
    "heat_map": set(),
    "copy_report": set(),
}
"""Operator -> properties that its button in the panel sets, or that a user chooses in its file
dialog."""


@pytest.mark.parametrize("name", SET_BY_PANEL)
def test_no_hidden_state_between_calls(extension, name):
    """Catches a script's `resume` or `own_offsets` that Blender remembers for the next click on a
    button.

    Without a window Blender remembers nothing, so what tells it not to is checked.
    """
    properties = getattr(bpy.ops.stga, name).get_rna_type().properties
    remembered = {prop.identifier for prop in properties if not prop.is_skip_save} - {"rna_type"}
    assert remembered <= SET_BY_PANEL[name]


def test_steps_wait_for_a_capture(extension):
    """Catches steps that run, and fail, before there is anything to work on."""
    for name in ("select", "train", "show_avatar", "export_avatar", "heat_map", "apply_motion"):
        assert not getattr(bpy.ops.stga, name).poll()
        with pytest.raises(RuntimeError, match="Import a capture first"):
            getattr(bpy.ops.stga, name)()


def test_mesh_capture_from_import_to_show(extension, mesh_capture, tmp_path):
    """Catches a chain that breaks between two operators: each works on what the one before left in
    the scene."""
    capture = open_capture(mesh_capture)
    assert bpy.ops.stga.import_capture(directory=str(mesh_capture)) == {"FINISHED"}
    scene = bpy.context.scene
    head = scene.stga.head
    assert (scene.frame_start, scene.frame_end) == (0, 3)
    assert (scene.render.resolution_x, scene.render.resolution_y) == (40, 60)
    scene.frame_set(3)
    np.testing.assert_allclose(evaluated_vertices(head), capture.mesh(3), atol=1e-6)

    assert bpy.ops.stga.select(threshold=0.0015) == {"FINISHED"}
    rule = select_capture(capture, SelectionOptions(threshold=0.0015))
    assert not rule[1].any()
    assert rule[3].any()
    written = read_selection(head)
    for timestep, selected in rule.items():
        np.testing.assert_array_equal(
            written[timestep], closure(selected, capture.faces) & selected.any()
        )

    avatar = write_ball_avatar(tmp_path / "avatar.npz")
    assert bpy.ops.stga.show_avatar(filepath=str(tmp_path / "avatar.npz")) == {"FINISHED"}
    assert_follow(capture, avatar, [3])


def test_flame_capture_from_import_to_show(extension, tmp_path):
    """Catches the same for a rigged head, whose mesh bones and correctives move, not one key a
    frame."""
    folder, model = write_flame_capture(tmp_path / "capture")
    capture = open_capture(folder, model)
    assert bpy.ops.stga.import_capture(directory=str(folder), flame=str(model)) == {"FINISHED"}
    scene = bpy.context.scene
    assert bpy.ops.stga.select(threshold=0.001) == {"FINISHED"}
    assert read_selection(scene.stga.head)[3].any()
    avatar = write_ball_avatar(tmp_path / "avatar.npz")
    assert bpy.ops.stga.show_avatar(filepath=str(tmp_path / "avatar.npz")) == {"FINISHED"}
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "flame.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "flame.blend"))
    assert_follow(capture, avatar, capture.timesteps)


def test_exports_read_back(shown, tmp_path):
    """Catches exports of the neutral pose, of the wrong frame, or in the head's turned world
    axes."""
    capture, avatar = shown
    bpy.context.scene.frame_set(3)
    assert bpy.ops.stga.export_avatar(filepath=str(tmp_path / "one.ply"), format="ply") == {
        "FINISHED"
    }
    at_3 = expected_world(avatar, capture.mesh(3)).xyz
    np.testing.assert_allclose(read_ply(tmp_path / "one.ply").xyz, at_3, atol=1e-5)
    assert bpy.ops.stga.export_avatar(filepath=str(tmp_path / "many"), format="ply-sequence") == {
        "FINISHED"
    }
    assert sorted(path.name for path in (tmp_path / "many").glob("*.ply")) == [
        f"{frame:05d}.ply" for frame in range(4)
    ]
    np.testing.assert_allclose(read_ply(tmp_path / "many/00003.ply").xyz, at_3, atol=1e-5)
    assert np.abs(read_ply(tmp_path / "many/00000.ply").xyz - at_3).max() > 1e-3
    assert bpy.context.scene.frame_current == 3
    with pytest.raises(RuntimeError, match="not tracked with FLAME"):
        bpy.ops.stga.export_avatar(filepath=str(tmp_path / "pair"), format="gaussian-avatars")


def test_exports_for_other_tools(shown, tmp_path):
    """Catches formats that Blender cannot write, frames left out, and a rate that is not the
    scene's."""
    usd = pytest.importorskip("pxr.Usd", reason="the package usd-core is not installed")
    capture, avatar = shown
    bpy.context.scene.render.fps = 30
    for name, format in {"a.usdz": "usd", "a.glb": "gltf", "a.spz": "spz"}.items():
        assert bpy.ops.stga.export_avatar(filepath=str(tmp_path / name), format=format) == {
            "FINISHED"
        }
        assert (tmp_path / name).stat().st_size > 0
    stage = usd.Stage.Open(str(tmp_path / "a.usdz"))
    assert stage.GetTimeCodesPerSecond() == 30
    positions = stage.GetPrimAtPath("/Avatar/Splats").GetAttribute("positions")
    assert positions.GetTimeSamples() == [0, 1, 2, 3]
    for frame in capture.timesteps:
        expected = expected_world(avatar, capture.mesh(frame)).xyz
        np.testing.assert_allclose(positions.Get(frame), expected, atol=1e-5)


def test_export_of_a_web_page(shown, tmp_path):
    """Catches a page of other frames than the scene's, at another rate, or seen from elsewhere than
    its camera."""
    scene = bpy.context.scene
    scene.render.fps, scene.frame_start = 30, 1
    assert bpy.ops.stga.export_avatar(filepath=str(tmp_path / "a.stga"), format="web") == {
        "FINISHED"
    }
    header, arrays = read_web_data((tmp_path / "a.stga").read_bytes())
    assert header["fps"] == 30
    assert len(arrays["translation"]) == 3
    centers = [shown[0].mesh(timestep).mean(0) for timestep in (1, 3)]
    np.testing.assert_allclose(arrays["translation"][[0, 2]], centers, atol=1e-5)
    camera = np.reshape(header["views"][0]["world_to_camera"], (4, 4))
    head_to_camera = np.array(scene.camera.matrix_world.inverted() @ scene.stga.head.matrix_world)
    np.testing.assert_allclose(camera, np.diag([1, -1, -1, 1]) @ head_to_camera, atol=1e-5)
    up = np.array(scene.stga.head.matrix_world.to_3x3()) @ header["up"]
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-5)


def range_export(
    extension, folder: Path, frames: range, stop_after: int | None = None
) -> list[Path]:
    """The files of a range exported step by step, as the dialog does; cancelled after some
    steps."""
    module = sys.modules[f"{extension.__name__}.operators.export_range"]

    def write(meshes):
        export_avatar(folder, read_avatar(folder.parent / "avatar.npz"), "ply-sequence", meshes)

    job = module.RangeExport(bpy.context.scene.stga.head, frames, write)
    operator = sys.modules[f"{extension.__name__}.operators.export"].ExportAvatar
    said = []
    context = SimpleNamespace(
        window_manager=SimpleNamespace(event_timer_remove=said.append),
        workspace=SimpleNamespace(status_text_set=said.append),
    )
    dialog = SimpleNamespace(
        _range=job, _timer="timer", filepath="", report=lambda kind, text: said.append(text)
    )
    dialog._end = lambda context: operator._end(dialog, context)
    result = {"RUNNING_MODAL"}
    while result == {"RUNNING_MODAL"}:
        key = "TIMER" if stop_after is None or job.done < stop_after else "ESC"
        result = operator.modal(dialog, context, SimpleNamespace(type=key))
        time.sleep(0.001)
    assert result == ({"FINISHED"} if stop_after is None else {"CANCELLED"})
    assert said[-3:-1] == ["timer", None]
    return sorted(folder.glob("*.ply"))


def test_a_range_is_exported_step_by_step(extension, mesh_capture, tmp_path):
    """Catches a dialog's export that differs from a script's, and one that leaves traces where it
    was cancelled."""
    bpy.ops.stga.import_capture(directory=str(mesh_capture))
    avatar = write_ball_avatar(tmp_path / "avatar.npz")
    bpy.context.scene.frame_set(1)
    files = range_export(extension, tmp_path / "whole", range(4))
    assert [path.name for path in files] == [f"{frame:05d}.ply" for frame in range(4)]
    expected = expected_world(avatar, open_capture(mesh_capture).mesh(3)).xyz
    np.testing.assert_allclose(read_ply(files[3]).xyz, expected, atol=1e-5)
    assert len(range_export(extension, tmp_path / "cut", range(4), stop_after=2)) <= 2
    assert not list((tmp_path / "cut").glob(".*"))
    assert bpy.context.scene.frame_current == 1


def test_a_range_that_cannot_be_written_says_why(extension, mesh_capture, tmp_path):
    """Catches an export whose thread fails in silence, or for which Blender waits for ever."""
    bpy.ops.stga.import_capture(directory=str(mesh_capture))
    module = sys.modules[f"{extension.__name__}.operators.export_range"]

    def write(meshes):
        next(iter(meshes))
        raise StgaError("no room")

    job = module.RangeExport(bpy.context.scene.stga.head, range(50), write)
    while job.step():
        time.sleep(0.001)
    with pytest.raises(StgaError, match="no room"):
        job.finish()


def test_gaussian_avatars_export(extension, tmp_path):
    """Catches an export that loses the motion or the binding on its way through Blender."""
    folder, model = write_flame_capture(tmp_path / "capture")
    bpy.ops.stga.import_capture(directory=str(folder), flame=str(model))
    avatar = write_ball_avatar(tmp_path / "avatar.npz", "gaussian_avatars")
    arguments = {
        "avatar": str(tmp_path / "avatar.npz"),
        "filepath": str(tmp_path / "pair"),
        "format": "gaussian-avatars",
    }
    assert bpy.ops.stga.export_avatar(**arguments) == {"FINISHED"}
    bound_to = read_vertices(tmp_path / "pair/point_cloud.ply")["binding_0"]
    np.testing.assert_array_equal(bound_to, avatar.splats.face)
    assert (tmp_path / "pair/flame_param.npz").is_file()


@pytest.mark.parametrize("up", ["Y", "-Y", "Z"])
def test_import_ply(extension, tmp_path, up):
    """Catches a scan that lies on its back: the file's up axis must point along Blender's z."""
    vertices, faces = ball()
    splats = replace(
        lattice_splats(vertices, faces.astype(np.int32), order=0),
        face=np.zeros(len(faces), np.int32),
    )
    write_ply(tmp_path / "scan.ply", splats)
    assert bpy.ops.stga.import_ply(filepath=str(tmp_path / "scan.ply"), up=up) == {"FINISHED"}
    shown = bpy.context.scene.stga.splats
    bpy.context.view_layer.update()
    axis = {"Y": (0, 1, 0), "-Y": (0, -1, 0), "Z": (0, 0, 1)}[up]
    np.testing.assert_allclose(np.array(shown.matrix_world)[:3, :3] @ axis, (0, 0, 1), atol=1e-6)
    assert len(evaluated_splats(shown)[0]) == len(splats)


@pytest.mark.parametrize(
    ("operator", "arguments", "sentence"),
    [
        (
            "import_capture",
            {"directory": "{folder}/nowhere"},
            r"^Error: .*nowhere: is not a folder",
        ),
        ("import_capture", {}, "no path given"),
        ("import_capture", {"directory": "//capture"}, "has not been saved yet"),
        ("import_capture", {"directory": "{folder}/capture"}, r"00003\.obj"),
        ("import_ply", {"filepath": "{folder}/broken.ply"}, r"broken.ply: is not a PLY file"),
    ],
)
def test_mistakes_are_sentences(extension, mesh_capture, tmp_path, operator, arguments, sentence):
    """Catches tracebacks, silence, and objects left behind by an import that failed."""
    (mesh_capture / "meshes/00003.obj").write_text("v 0 0 nan\n")
    (tmp_path / "broken.ply").write_bytes(b"ply\n")
    with pytest.raises(RuntimeError, match=sentence):
        getattr(bpy.ops.stga, operator)(
            **{name: text.format(folder=tmp_path) for name, text in arguments.items()}
        )
    assert not bpy.data.objects


def test_a_capture_that_is_gone_is_named(extension, mesh_capture):
    """Catches a traceback when the capture moved after the .blend was saved."""
    bpy.ops.stga.import_capture(directory=str(mesh_capture))
    mesh_capture.rename(mesh_capture.with_name("elsewhere"))
    with pytest.raises(RuntimeError, match=r"capture: is not a folder"):
        bpy.ops.stga.select()


def test_standard_view(extension):
    """Catches a one-click cure that does not cure: AgX turns trained colors gray."""
    bpy.context.scene.view_settings.view_transform = "AgX"
    bpy.ops.stga.standard_view()
    assert bpy.context.scene.view_settings.view_transform == "Standard"


def test_a_hidden_head_still_moves_its_splats(shown):
    """Catches splats that stand still once the mesh below them is hidden, as show does."""
    scene = bpy.context.scene
    assert scene.stga.head.hide_render
    assert not scene.stga.head.visible_get()
    assert_follow(*shown, (3, 0, 1))


def test_show_selection_after_select(shown):
    """Catches the two sides of the vertex groups' name and weight drifting apart: Python writes,
    nodes read."""
    bpy.ops.stga.select(threshold=0.0015)
    scene, (_, avatar) = bpy.context.scene, shown
    set_input(scene.stga.splats, splat_nodes.DISPLAY, POINTS)
    set_input(scene.stga.splats, splat_nodes.SHOW_SELECTION, True)
    scene.frame_set(3)
    points = next(
        item.object.data
        for item in bpy.context.evaluated_depsgraph_get().object_instances
        if item.object.type == "POINTCLOUD"
    )
    color = np.empty(4 * len(points.points), np.float32)
    points.attributes["stga_display_color"].data.foreach_get("color", color)
    frozen = np.isclose(color.reshape(-1, 4), splat_nodes.FROZEN_COLOR).all(1)
    np.testing.assert_array_equal(~frozen, read_selection(scene.stga.head)[3][avatar.splats.face])
