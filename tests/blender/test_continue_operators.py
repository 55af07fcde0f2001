"""Refine and Extend from Blender: what is painted or selected reaches the worker, and the preview
stays in place."""

import tempfile

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from capture.factory import write_mesh_capture  # noqa: E402

from stga_addon.avatar.file import read_avatar  # noqa: E402
from stga_addon.jobs.monitor_state import RequestState  # noqa: E402
from stga_addon.jobs.table import Kind  # noqa: E402
from stga_addon.training.run.folder import read_run  # noqa: E402

from .test_analyze_operator import error_of, tick_until_done, write_interpreter  # noqa: E402
from .test_operators import write_ball_avatar  # noqa: E402
from .test_train_operators import ask_only  # noqa: E402


@pytest.fixture
def head(extension, tmp_path):
    """The head of a mesh capture, with a painted vertex group of forty triangles."""
    bpy.ops.stga.import_capture(directory=str(write_mesh_capture(tmp_path / "capture")))
    head = bpy.context.scene.stga.head
    corners = np.array([polygon.vertices[:] for polygon in head.data.polygons])
    group = head.vertex_groups.new(name="cheek")
    group.add(np.unique(corners[:40]).tolist(), 0.8, "REPLACE")
    head.vertex_groups.new(name="faint").add(np.unique(corners[:40]).tolist(), 0.3, "REPLACE")
    return head


@pytest.fixture
def asked(extension, monkeypatch):
    """What operators that train ask for; nothing is trained."""
    return ask_only(monkeypatch, extension)


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    write_ball_avatar(folder / "avatar.npz")
    return folder


def test_painted_group_becomes_the_region(head, asked, run):
    """Catches a region of other triangles than those painted, and settings of the panel that are
    lost."""
    chosen = {"device": "gpu", "adapter": "Card (Vulkan)", "seconds": 7, "growth": 0.5}
    assert bpy.ops.stga.refine(directory=str(run), group="cheek", first=1, last=3, **chosen) == {
        "FINISHED"
    }
    new = run.with_name("run_2")
    (wanted,) = asked
    assert (wanted.run, wanted.parent, wanted.device) == (new, run, "gpu:Card (Vulkan)")
    assert (wanted.frames, wanted.seconds, wanted.growth) == ((1, 3), 7, 0.5)
    weights = wanted.weights
    assert weights[:40] == pytest.approx(0.8)
    assert (weights >= 0.5).sum() < 80
    assert bpy.context.scene.stga.run_folder == str(new)


def test_faces_selected_in_edit_mode_become_the_region(head, asked, run):
    """Catches a selection as it was before Edit Mode, and a vertex group used although faces are
    selected."""
    head.hide_set(False)
    bpy.context.view_layer.objects.active = head
    for polygon in head.data.polygons:
        polygon.select = polygon.index in (3, 5, 8)
    bpy.context.tool_settings.mesh_select_mode = (False, False, True)
    bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.stga.refine(directory=str(run), seconds=3) == {"FINISHED"}
    assert np.flatnonzero(asked[-1].weights).tolist() == [3, 5, 8]
    bpy.ops.object.mode_set(mode="OBJECT")


def test_splats_of_the_run_before_show_the_new_one(head, asked, run, extension):
    """Catches a preview in a second object over the first one."""
    assert bpy.ops.stga.show_avatar(filepath=str(run / "avatar.npz")) == {"FINISHED"}
    shown = bpy.context.scene.stga.splats
    assert bpy.ops.stga.refine(directory=str(run), region="mouth", seconds=3) == {"FINISHED"}
    new = run.with_name("run_2")
    assert asked[-1].region == "mouth"
    assert shown[extension.stga_addon.scene.tags.RUN] == str(new)


def test_mistakes_are_sentences(head, asked, run, tmp_path):
    """Catches tracebacks, and folders begun for what cannot be trained."""
    for operator, arguments, sentence in (
        (bpy.ops.stga.refine, {"group": "chin"}, "has no vertex group 'chin'"),
        (
            bpy.ops.stga.refine,
            {"group": "faint"},
            "no triangle has all its corners in the vertex group 'faint'",
        ),
        (
            bpy.ops.stga.refine,
            {"directory": str(tmp_path / "none"), "group": "cheek"},
            "holds no trained avatar",
        ),
        (bpy.ops.stga.extend, {"take": str(tmp_path / "none")}, "is not a folder"),
        (bpy.ops.stga.extend, {"take": ""}, "take: no path given"),
    ):
        with pytest.raises(RuntimeError, match=f"^Error: .*{sentence}"):
            operator(**{"directory": str(run), **arguments})
    assert not run.with_name("run_2").exists()


def test_residuals_are_shown_on_the_head(head, run, extension):
    """Catches a heat map of other triangles than those with the error, and unknown ones that are
    shown as bad."""
    residual = np.full(len(head.data.polygons), 0.01, np.float32)
    residual[7], residual[9] = 0.2, np.nan
    extension.stga_addon.training.run.folder.write_residuals(run, residual)
    assert bpy.ops.stga.heat_map(of="RESIDUAL", directory=str(run)) == {"FINISHED"}
    shown = np.array([item.value for item in head.data.attributes["stga_residual"].data])
    assert shown.argmax() == 7
    assert shown[9] == 0
    red = np.array([item.color[0] for item in head.data.attributes["stga_heat"].data]).reshape(
        -1, 3
    )
    assert red[7] == pytest.approx(0.9, abs=0.01)
    assert bpy.ops.stga.heat_map(show=False) == {"FINISHED"}
    assert not {"stga_residual", "stga_heat"} & set(head.data.attributes.keys())
    with pytest.raises(RuntimeError, match=r"^Error: .*residuals\.npz"):
        bpy.ops.stga.heat_map(of="RESIDUAL", directory=str(run.parent))


def answer(extension, tmp_path, selection) -> str:
    """The body of a stand-in for a worker that selects these triangles."""
    given = tmp_path / "given"
    given.mkdir(exist_ok=True)
    jobs = extension.stga_addon.jobs
    jobs.perform.write_result(given, jobs.train.Selected(selection))
    return f"shutil.copytree({str(given)!r}, FOLDER, dirs_exist_ok=True)\nend('finished')"


def test_what_an_extension_would_train_is_selected(head, run, extension, monkeypatch, tmp_path):
    """Catches a selection of other frames or triangles than the worker found, and a failure that
    shows nowhere."""
    selection = {timestep: np.arange(len(head.data.polygons)) < 40 for timestep in (0, 3)}
    selection[3] = ~selection[3]
    program = write_interpreter(tmp_path / "python", answer(extension, tmp_path, selection))
    monkeypatch.setattr(
        extension.operators.select_extension, "training_python", lambda context: program
    )
    settings = bpy.context.scene.stga
    assert bpy.ops.stga.select_extension(directory=str(run)) == {"FINISHED"}
    shown = extension.stga_addon.scene.vertex_groups.read_selection(head)
    for timestep, faces in selection.items():
        assert shown[timestep][faces].all()
        assert shown[timestep].mean() < 0.9 or timestep
    assert not shown[1].any()
    assert [row.frame for row in settings.selected_frames if row.triangles] == [0, 3]
    program = write_interpreter(tmp_path / "python", "end('failed', 'no such run')")
    with pytest.raises(RuntimeError, match="no such run"):
        bpy.ops.stga.select_extension(directory=str(run))
    assert error_of(extension, Kind.SELECTION) == "no such run"


def test_selection_of_another_head_or_cancelled_changes_nothing(
    head, run, extension, monkeypatch, tmp_path
):
    """Catches a selection written to the head imported meanwhile, and files that a cancelled
    command leaves."""
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    given = answer(extension, tmp_path, {0: np.ones(len(head.data.polygons), bool)})
    wait = f"while not pathlib.Path({str(tmp_path / 'go')!r}).exists(): time.sleep(0.02)\n"
    program = write_interpreter(tmp_path / "python", wait + given)
    settings = bpy.context.scene.stga
    monkeypatch.setattr(
        extension.operators.select_extension, "training_python", lambda context: program
    )
    monkeypatch.setattr(extension.operators.monitor, "has_timer", lambda: True)
    assert bpy.ops.stga.select_extension(directory=str(run)) == {"FINISHED"}
    assert any(temporary.iterdir())
    assert not bpy.ops.stga.select_extension.poll()
    assert bpy.ops.stga.cancel(request="selection") == {"FINISHED"}
    assert not any(temporary.iterdir())
    assert bpy.ops.stga.select_extension(directory=str(run)) == {"FINISHED"}
    bpy.ops.stga.import_capture(directory=str(write_mesh_capture(tmp_path / "other")))
    (tmp_path / "go").touch()
    tick_until_done(extension, Kind.SELECTION)
    assert error_of(extension, Kind.SELECTION).endswith("its head is no longer that of the scene")
    assert "stga_0" not in head.vertex_groups
    assert "stga_0" not in settings.head.vertex_groups
    assert not any(temporary.iterdir())


def test_selection_waits_for_the_end_of_edit_mode(head, run, extension, monkeypatch, tmp_path):
    """Catches a result lost because the head is edited, a failure held back, and an old error
    beside a new command."""
    given = answer(extension, tmp_path, {0: np.ones(len(head.data.polygons), bool)})
    program = write_interpreter(tmp_path / "python", given)
    monitor = extension.operators.monitor
    monkeypatch.setattr(
        extension.operators.select_extension, "training_python", lambda context: program
    )
    monkeypatch.setattr(extension.operators.monitor, "has_timer", lambda: True)
    bpy.context.view_layer.objects.active = head
    bpy.ops.object.mode_set(mode="EDIT")
    monitor._states[bpy.context.scene.session_uid, Kind.SELECTION] = RequestState(
        Kind.SELECTION, error="of last time"
    )
    assert bpy.ops.stga.select_extension(directory=str(run)) == {"FINISHED"}
    assert error_of(extension, Kind.SELECTION) == ""
    state = monitor.state_of(bpy.context.scene, Kind.SELECTION)
    monitor._processes[state.folder].wait(60)
    assert monitor.tick() is not None
    assert monitor.state_of(bpy.context.scene, Kind.SELECTION).loading is not None
    assert "stga_0" not in head.vertex_groups
    bpy.ops.object.mode_set(mode="OBJECT")
    tick_until_done(extension, Kind.SELECTION)
    assert error_of(extension, Kind.SELECTION) == ""
    assert extension.stga_addon.scene.vertex_groups.read_selection(head)[0].all()
    bpy.ops.object.mode_set(mode="EDIT")
    write_interpreter(tmp_path / "python", "end('failed', 'no such run')")
    assert bpy.ops.stga.select_extension(directory=str(run)) == {"FINISHED"}
    tick_until_done(extension, Kind.SELECTION)
    assert error_of(extension, Kind.SELECTION) == "no such run"
    bpy.ops.object.mode_set(mode="OBJECT")


@pytest.mark.slow
def test_refine_and_extend_end_to_end(head, tmp_path):
    """Catches a job that the worker does not understand, and an avatar that is not that of the
    continued run."""
    pytest.importorskip("torch")
    run = tmp_path / "run"
    assert bpy.ops.stga.train(directory=str(run), iterations=6, device="cpu") == {"FINISHED"}
    assert bpy.ops.stga.refine(directory=str(run), group="cheek", iterations=4) == {"FINISHED"}
    before, after = (
        read_avatar(tmp_path / name / "avatar.npz").splats for name in ("run", "run_2")
    )
    same = (before.sh == after.sh).all((1, 2))
    assert not same.all()
    assert same[before.face >= 80].all()
    take = write_mesh_capture(tmp_path / "take")
    bpy.ops.stga.import_capture(directory=str(take))
    assert bpy.ops.stga.select_extension(directory=str(tmp_path / "run_2")) == {"FINISHED"}
    assert bpy.ops.stga.extend(directory=str(tmp_path / "run_2"), take=str(take), iterations=4) == {
        "FINISHED"
    }
    assert len(read_run(tmp_path / "run_3").takes) == 1
    assert bpy.context.scene.stga.avatar == str(tmp_path / "run_3" / "avatar.npz")
