"""Training from Blender; timers need a window, so tests call their function."""

import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from capture.factory import write_mesh_capture

from stga_addon.avatar.file import read_avatar, write_avatar
from stga_addon.development.demo.in_blender import evaluated_splats
from stga_addon.jobs.table import Kind
from stga_addon.progress import Progress

from .session import failure, open_file, ops, panel, save, state_of, write_interpreter
from .test_operators import write_ball_avatar


@pytest.fixture
def head(head):
    """With a selection."""
    ops.select(threshold=0.0005)
    return head


def tick_until(monitor, done):
    for _ in range(200):
        monitor.tick()
        if done():
            return
        time.sleep(0.02)
    raise AssertionError("the expected state was not reached")


@pytest.mark.slow
def test_resume_of_another_capture_is_refused(extension, tmp_path):
    """Catches a run overwritten, or continued on another capture or principal point."""
    pytest.importorskip("torch")
    one = write_mesh_capture(tmp_path / "one")
    other = write_mesh_capture(tmp_path / "other", timesteps=(0, 5))
    run = tmp_path / "run"
    folder = str(tmp_path / "run")
    ops.import_capture(directory=one, principal_point="opencv")
    ops.train(directory=folder, iterations=3, device="cpu")
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    mistakes = (
        (other, "opencv", rf"^Error: .*run: was trained on {one} .*{other}"),
        (one, "vhap", "was trained with principal point 'opencv', not 'vhap'"),
    )
    for capture, principal_point, sentence in mistakes:
        ops.import_capture(directory=capture, principal_point=principal_point)
        with failure(sentence):
            ops.train(directory=folder, resume=True)
        assert {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()} == before
    ops.import_capture(directory=one, principal_point="opencv")
    ops.train(directory=folder, resume=True)


def test_an_occupied_folder_and_more_training(extension, head, asked, tmp_path, monkeypatch):
    """Catches a run that is overwritten or refused where the next folder is free, a panel that
    still names the one before, and *More* that asks for the budget of before."""
    settings = panel()
    run = tmp_path / "run"
    run.mkdir()
    monkeypatch.setattr(extension.operators.train, "has_run", run.__eq__)
    for given, expected in ((run, tmp_path / "run_2"), (tmp_path / "b", tmp_path / "b")):
        settings.run_folder = str(given)
        ops.train(directory=given, iterations=3)
        assert asked.pop().run == Path(settings.run_folder) == expected
    stored = SimpleNamespace(takes=())
    monkeypatch.setattr(extension.operators.train, "read_run", lambda _: stored)
    ops.train(directory=run, minutes=3, more=True)
    ops.train(directory=run, minutes=3, resume=True)
    assert [(request.run, request.more_s) for request in asked] == [(run, 180), (run, None)]


def test_device_reaches_the_request(extension, head, asked, tmp_path, monkeypatch):
    """Catches a device or GPU's name that training does not get, and another Python's list."""
    test = extension.operators.training_python.test
    for device, adapter, wanted in (
        ("gpu", "", "gpu"),
        ("gpu", "Card (Vulkan)", "gpu:Card (Vulkan)"),
        ("cpu", "Card", "cpu"),
    ):
        ops.train(directory=tmp_path / "run", device=device, adapter=adapter)
        assert asked[-1].device == wanted
    for adapters in ((), ("Card (Vulkan)", "Card (Vulkan) #2")):
        checked = extension.operators.training_python.Checked("", adapters) if adapters else None
        monkeypatch.setattr(test, "found", checked)
        assert extension.operators.train.list_adapters(None, None, "") == [*adapters]


def test_mistakes_of_training_are_sentences(extension, head, tmp_path, monkeypatch):
    """Catches tracebacks and silence for impossible folders, interpreters and captures."""
    (tmp_path / "file").write_text("")
    run = str(tmp_path / "run")
    for arguments, sentence in (
        ({"directory": ""}, "run folder: no path given"),
        ({"directory": "//run"}, "relative to the .blend file, which has not been saved yet"),
        ({"directory": tmp_path / "file"}, "cannot be written"),
        ({"resume": True}, "holds no run"),
        ({"python": tmp_path / "no_python"}, "no_python: cannot be started as a Python"),
    ):
        with failure(f"^Error: .*{sentence}"):
            ops.train(**{"directory": run, "iterations": 2, **arguments})
    monkeypatch.setattr(extension.stga_addon.worker.training_python, "find_spec", lambda name: None)
    monkeypatch.setattr(extension.operators.train, "missing_packages", lambda: ["torch"])
    expected = r"^Error: .* \(Python .*\) lacks numpy, torch, numba, scipy, pillow, "
    with failure(expected):
        ops.train(directory=tmp_path / "new", minutes=0.1)
    assert not (tmp_path / "new").exists()
    assert ops.train.poll()
    (tmp_path / "capture").rename(tmp_path / "elsewhere")
    with failure(r"its capture is no longer at .*capture; Import Capture"):
        ops.train(directory=run)


def test_a_cancelled_training_that_is_waited_for(head, tmp_path):
    """Catches a cancel told as a failure, and an avatar so far that is not stored."""
    body = "(FOLDER.parent / 'avatar.npz').touch(); end('cancelled')"
    python = write_interpreter(tmp_path / "python", body)
    ops.train(directory=tmp_path / "run", iterations=2, python=python)
    assert panel().avatar == str(tmp_path / "run/avatar.npz")


def test_running_worker_cannot_be_replaced_or_dismissed(worker):
    """Catches a second worker, a dismissed one that goes on, and a user's files deleted."""
    assert not ops.train.poll()
    assert not ops.dismiss.poll()
    ops.cancel(request="training")
    assert worker.report(Progress(0.5, "Training"))
    (worker.folder / "notes.txt").write_text("mine")
    worker.leave()
    assert not ops.cancel.poll()
    assert ops.train.poll()
    ops.dismiss(request="training")
    assert [path.name for path in worker.folder.iterdir()] == ["notes.txt"]
    assert panel().training_run == ""
    assert not ops.dismiss.poll()


def test_dismiss_follows_no_path_to_other_folders(extension, tmp_path):
    """Catches a .blend file whose stored path makes Dismiss delete other files."""
    folder = tmp_path / "documents/job"
    folder.mkdir(parents=True)
    names = ["preview.npz", "result.json", "selection.npz", "status.json", "worker.log"]
    for name in names:
        (folder / name).write_text("[]")
    panel().training_run = str(tmp_path / "documents")
    extension.operators.monitor.tick()
    ops.dismiss(request="training")
    assert sorted(path.name for path in folder.iterdir()) == names
    assert panel().training_run == ""


def test_live_preview_refreshes_one_object(extension, worker, tmp_path):
    """Catches an object for each preview, and splats whose number may not change."""
    monitor = extension.operators.monitor
    scene = bpy.context.scene
    preview = worker.folder / "preview.npz"
    write_ball_avatar(preview)
    tick_until(monitor, lambda: scene.stga.splats is not None)
    shown = scene.stga.splats
    assert scene.stga.head.hide_render
    count = len(evaluated_splats(shown)[0])
    objects = len(bpy.data.objects)

    avatar = read_avatar(preview)
    keep = np.arange(count) % 3 > 0
    fewer = avatar.splats.rows(np.flatnonzero(keep))
    fewer.xyz[:] += 0.01
    write_avatar(preview, replace(avatar, splats=fewer))
    tick_until(monitor, lambda: len(shown.data.vertices) == keep.sum())
    bpy.context.view_layer.update()
    assert len(evaluated_splats(shown)[0]) == keep.sum()
    assert len(bpy.data.objects) == objects
    assert scene.stga.splats == shown

    scene.stga.live_preview = False
    write_ball_avatar(preview)
    for _ in range(5):
        assert monitor.tick() is not None
        time.sleep(0.02)
    assert len(shown.data.vertices) == keep.sum()


@pytest.mark.parametrize("wanted", [True, False])
def test_result_reaches_the_scene_once(extension, worker, wanted):
    """Catches a result not shown, unwanted, or shown again at every reopening."""
    monitor = extension.operators.monitor
    scene = bpy.context.scene
    scene.stga.show_result = wanted
    write_ball_avatar(worker.run / "avatar.npz")
    worker.leave()
    tick_until(monitor, lambda: scene.stga.result_shown)
    assert scene.stga.avatar == str(worker.run / "avatar.npz")
    assert (scene.stga.splats is not None) == wanted
    assert monitor.tick() is None
    if wanted:
        bpy.data.objects.remove(scene.stga.splats)
        assert monitor.tick() is None
        assert scene.stga.splats is None


def test_save_and_reopen_while_it_trains(extension, worker, tmp_path):
    """Catches a training that a saved file or undo forgets, or that cannot be cancelled at once."""
    monitor = extension.operators.monitor
    path = str(tmp_path / "head.blend")
    save(path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert monitor.tick() is None
    open_file(path)
    ops.cancel(request="training")
    assert worker.report(Progress(0.5, "Training"))
    assert monitor.tick() is not None
    assert not ops.train.poll()
    panel().training_run = ""
    assert monitor.tick() is not None
    assert panel().training_run == str(worker.run)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    write_ball_avatar(worker.run / "avatar.npz")
    worker.leave()
    open_file(path)
    tick_until(monitor, lambda: panel().result_shown)
    assert panel().splats is not None


def test_moved_blend_file(extension, worker, tmp_path):
    """Catches a training lost when file and run move together, and silence when it is gone."""
    monitor = extension.operators.monitor
    scene = bpy.context.scene
    worker.leave()
    scene.stga.run_folder = "//run"
    scene.stga.show_result = False
    save(tmp_path / "head.blend")
    moved = tmp_path / "moved"
    moved.mkdir()
    (tmp_path / "run").rename(moved / "run")
    save(moved / "head.blend")
    assert state_of(Kind.TRAINING).place == moved / "run"
    tick_until(monitor, lambda: panel().result_shown)
    (moved / "run").rename(moved / "gone")
    assert state_of(Kind.TRAINING).snapshot.state == "none"
    assert state_of(Kind.TRAINING).place == tmp_path / "run"
    ops.dismiss(request="training")


@pytest.mark.slow
def test_python_is_tested_without_a_window(extension):
    """Catches a test of a Python that a script cannot make, or that finds nothing wrong."""
    with failure("is not a Python that runs this add-on"):
        ops.test_python(python="false")
    ops.test_python(python=sys.executable)
    assert extension.operators.training_python.test.found.line.startswith(
        f"Python {sys.version.split()[0]}, torch "
    )
