"""Refine and Extend from Blender: what is painted or selected reaches the worker."""

import bpy
import numpy as np
import pytest
from capture.factory import write_mesh_capture

from stga_addon.avatar.file import read_avatar
from stga_addon.jobs.monitor_state import RequestState
from stga_addon.jobs.table import Kind
from stga_addon.scene.display.splat_attributes import read_attribute
from stga_addon.training.run.folder import read_run

from .session import failure, ops, panel, state_of, write_interpreter
from .test_analyze_operator import tick_until_done
from .test_operators import write_ball_run


@pytest.fixture
def head(head):
    """With a painted vertex group of forty triangles."""
    corners = np.array([polygon.vertices[:] for polygon in head.data.polygons])
    group = head.vertex_groups.new(name="cheek")
    group.add(np.unique(corners[:40]).tolist(), 0.8, "REPLACE")
    head.vertex_groups.new(name="faint").add(np.unique(corners[:40]).tolist(), 0.3, "REPLACE")
    return head


@pytest.fixture
def run(tmp_path):
    return write_ball_run(tmp_path / "run")


def test_what_is_painted_or_selected_becomes_the_region(head, asked, run, extension):
    """Catches another region or selection, and lost settings."""
    chosen = {"device": "gpu", "adapter": "Card (Vulkan)", "seconds": 7, "growth": 0.5}
    ops.refine(directory=run, group="cheek", first=1, last=3, **chosen)
    new = run.with_name("run_2")
    (wanted,) = asked
    assert (wanted.run, wanted.parent, wanted.device) == (new, run, "gpu:Card (Vulkan)")
    assert (wanted.frames, wanted.seconds, wanted.growth) == ((1, 3), 7, 0.5)
    assert wanted.weights[:40] == pytest.approx(0.8)
    assert (wanted.weights >= 0.5).sum() < 80
    ops.refine(directory=run, region="mouth", seconds=3)
    assert (asked[-1].region, asked[-1].weights) == ("mouth", None)
    head.hide_set(False)
    bpy.context.view_layer.objects.active = head
    for polygon in head.data.polygons:
        polygon.select = polygon.index in (3, 5, 8)
    bpy.context.tool_settings.mesh_select_mode = (False, False, True)
    bpy.ops.object.mode_set(mode="EDIT")
    ops.refine(directory=run, seconds=3)
    assert np.flatnonzero(asked[-1].weights).tolist() == [3, 5, 8]
    bpy.ops.object.mode_set(mode="OBJECT")


def test_the_panel_stays_at_the_run_until_another_continues_it(
    extension, head, run, monkeypatch, tmp_path
):
    """Catches a panel at an empty run after a failure, which refuses the next attempt; and one that
    does not go on to the run that was trained."""
    monitor = extension.operators.monitor
    settings = panel()
    monkeypatch.setattr(extension.operators.timers, "has_timer", lambda: True)
    settings.run_folder = str(run)
    settings.avatar = str(run / "avatar.npz")
    ends = {
        "failed": "end('failed', 'no camera sees it')",
        "finished": f"shutil.copy({settings.avatar!r}, FOLDER.parent)\nend('finished')",
    }
    for state, body in ends.items():
        python = write_interpreter(tmp_path / "python", body)
        ops.refine(directory=settings.run_folder, group="cheek", python=python)
        monitor._processes[state_of(Kind.TRAINING).folder].wait(60)
        tick_until_done(extension, Kind.TRAINING)
        assert state_of(Kind.TRAINING).snapshot.state == state
        new = settings.training_run if state == "finished" else str(run)
        assert (settings.run_folder, settings.avatar) == (new, f"{new}/avatar.npz")


def test_mistakes_are_sentences(head, asked, run, tmp_path):
    """Catches tracebacks, and folders begun for what cannot be trained."""
    few = "no triangle has all its corners in the vertex group 'faint'"
    none = str(tmp_path / "none")
    for operator, arguments, sentence in (
        (ops.refine, {"group": "chin"}, "has no vertex group 'chin'"),
        (ops.refine, {"group": "faint"}, few),
        (ops.refine, {"directory": none, "group": "cheek"}, "holds no trained avatar"),
        (ops.extend, {"take": none}, "does not exist; expected a further capture"),
        (ops.extend, {"take": ""}, "take: no path given"),
    ):
        with failure(f"^Error: .*{sentence}"):
            operator(**{"directory": run, **arguments})
    assert not run.with_name("run_2").exists()


def test_residuals_are_shown_on_the_head(head, run, extension):
    """Catches a heat map of other triangles, and unknown ones shown as bad."""
    residual = np.full(len(head.data.polygons), 0.01, np.float32)
    residual[7] = 0.2
    residual[9] = np.nan
    extension.stga_addon.training.run.folder.write_residuals(run, residual)
    ops.heat_map(of="RESIDUAL", directory=run)
    shown = read_attribute(head.data, "stga_residual")
    assert shown.argmax() == 7
    assert shown[9] == 0
    red = read_attribute(head.data, "stga_heat")[:, 0]
    assert red.reshape(-1, 3)[7] == pytest.approx(0.9, abs=0.01)
    ops.heat_map(show=False)
    assert not {"stga_residual", "stga_heat"} & set(head.data.attributes.keys())
    with failure(r"^Error: .*residuals\.npz"):
        ops.heat_map(of="RESIDUAL", directory=run.parent)


def test_a_result_waits_for_the_end_of_edit_mode(head, extension, monkeypatch, tmp_path):
    """Catches a result lost or put into a mesh in Edit Mode, and an error of last time."""
    monitor = extension.operators.monitor
    monkeypatch.setattr(extension.operators.timers, "has_timer", lambda: True)
    state = RequestState(Kind.PERFORMANCE, error="of last time")
    monitor._states[bpy.context.scene.session_uid, Kind.PERFORMANCE] = state
    folder = tmp_path / "request"
    monitor.follow(bpy.context.scene, Kind.PERFORMANCE, tmp_path / "gone.csv", folder)
    assert state_of(Kind.PERFORMANCE).error == ""
    with extension.stga_addon.worker.status.status_writer(folder) as writer:
        writer.finish(extension.stga_addon.worker.status.WorkerState.FINISHED)
    bpy.context.view_layer.objects.active = head
    bpy.ops.object.mode_set(mode="EDIT")
    assert monitor.tick() is not None
    assert state_of(Kind.PERFORMANCE).loading is not None
    bpy.ops.object.mode_set(mode="OBJECT")
    tick_until_done(extension, Kind.PERFORMANCE)
    assert "has no FLAME rig" in state_of(Kind.PERFORMANCE).error


@pytest.mark.slow
def test_refine_and_extend_end_to_end(head, tmp_path):
    """Catches a job that the worker does not understand, and an avatar of another run."""
    pytest.importorskip("torch")
    run = tmp_path / "run"
    ops.train(directory=run, iterations=6, device="cpu")
    ops.refine(directory=run, group="cheek", iterations=4)
    runs = ("run", "run_2")
    before, after = (read_avatar(tmp_path / name / "avatar.npz").splats for name in runs)
    same = (before.sh == after.sh).all((1, 2))
    assert not same.all()
    assert same[before.face >= 80].all()
    take = write_mesh_capture(tmp_path / "take")
    ops.import_capture(directory=take)
    ops.extend(directory=tmp_path / "run_2", take=take, iterations=4)
    assert len(read_run(tmp_path / "run_3").takes) == 1
    assert panel().avatar == str(tmp_path / "run_3" / "avatar.npz")
