"""Runs inside a Blender with a window, started by test_scenario.py: trains as a user would, and
kills the worker.

`blender [FILE] --python scenario.py -- PART RESULT CAPTURE BLEND PYTHON`: PART is the name of a
function below, RESULT the JSON file that says what was seen.
"""

import os
import signal
import sys
from pathlib import Path

import bpy
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).parent))

from in_window import ARGUMENTS, chosen, extension, in_viewport, module, play, seen

PART, RESULT, CAPTURE, BLEND, PYTHON = ARGUMENTS
PATIENCE_S = 1200.0
"""Compiling kernels for the first time takes a minute, and far longer on a busy machine."""
monitor = module("operators.monitor")
test = module("operators.training_python").test
lock_owner = module("stga_addon.worker.lock").lock_owner


def request(kind):
    return monitor.state_of(bpy.context.scene, monitor.Kind(kind))


def state():
    return str(request("training").snapshot.state)


def figures():
    return dict(request("training").snapshot.status.figures)


def is_training():
    return state() == "working" and figures().get("iteration", 0) > 0


def avatar():
    """The file that the panel names, relative to the .blend file where it can be."""
    return bpy.path.abspath(chosen().avatar)


def splats():
    return 0 if chosen().splats is None else len(chosen().splats.data.vertices)


def job_folder():
    return Path(request("training").folder)


def first():
    """Train, cancel, resume, crash, report, undo, reopen, and leave with the worker at work."""
    bpy.context.preferences.addons[extension].preferences.training_python = PYTHON
    bpy.ops.wm.save_userpref()
    bpy.ops.stga.test_python()
    yield lambda: test.process is None
    seen["tested"] = test.found.line if test.found else test.error
    with in_viewport():
        bpy.ops.stga.import_capture(directory=CAPTURE)
    yield looks_at_head
    bpy.ops.stga.select()
    bpy.ops.wm.save_as_mainfile(filepath=BLEND)
    bpy.ops.stga.train(directory="//run", minutes=30)
    yield lambda: is_training() and splats() > 0
    seen["figures"] = figures()
    before = splats_at_work()
    yield lambda: splats_at_work() != before
    seen["refreshed"] = True

    bpy.ops.stga.cancel(request="training")
    yield lambda: state() == "cancelled" and chosen().result_shown
    seen["cancelled"] = {"avatar": Path(avatar()).exists(), "splats": splats()}

    bpy.ops.stga.train(directory="//run", resume=True)
    yield is_training
    seen["resumed at"] = figures()["iteration"]
    os.kill(lock_owner(job_folder() / "worker.lock"), signal.SIGKILL)
    yield lambda: state() == "lost"
    seen["lost"] = request("training").snapshot.status.error
    bpy.ops.stga.copy_report()
    seen["clipboard"] = bpy.context.window_manager.clipboard

    bpy.ops.stga.train(directory="//run", resume=True)
    yield is_training
    bpy.ops.ed.undo_push(message="before")
    with in_viewport():
        while chosen().training_run and bpy.ops.ed.undo.poll():
            bpy.ops.ed.undo()
    seen["undone"] = chosen().training_run
    yield lambda: is_training() and chosen().training_run != ""
    with in_viewport():
        while bpy.ops.ed.redo.poll():
            bpy.ops.ed.redo()
    yield is_training
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=BLEND)
    yield is_training
    before = figures()["iteration"]
    yield lambda: figures()["iteration"] > before
    seen["reopened"] = True
    seen["left"] = lock_owner(job_folder() / "worker.lock")
    bpy.ops.wm.save_mainfile()


def second():
    """Find the worker that went on while Blender was closed; then a short run."""
    seen["found"] = lock_owner(job_folder() / "worker.lock")
    yield is_training
    bpy.ops.stga.cancel(request="training")
    yield lambda: state() == "cancelled" and chosen().result_shown
    before = figures()["iteration"]
    bpy.ops.stga.train(directory="//run", minutes=0.05, more=True)
    yield lambda: state() == "finished" and chosen().result_shown
    seen["more"] = figures()["iteration"] - before
    bpy.ops.stga.train(directory="//run", iterations=30)  # into the next free folder
    yield lambda: state() == "finished" and chosen().result_shown
    seen["finished"] = {"avatar": avatar(), "splats": splats()}
    yield from videos()
    bpy.ops.stga.dismiss(request="training")
    seen["dismissed"] = chosen().training_run == ""


def videos():
    """A video cancelled while it is recorded, one while rendered, and a finished one."""
    folder = Path(BLEND).parent
    scene = bpy.context.scene
    scene.frame_set(1)
    for name in ("recording", "rendering", "finished"):
        with in_viewport():
            bpy.ops.stga.render_video(filepath=str(folder / name), seconds=0.5)
        video = request("video").folder
        if name != "recording":
            yield (
                lambda: (
                    request("video").is_running
                    and request("video").snapshot.status.message != "Recording"
                )
            )
        if name != "finished":
            bpy.ops.stga.cancel(request="video")
        yield lambda: not request("video").is_running
        if name != "recording":
            seen[f"video {name}"] = str(request("video").snapshot.state)
            bpy.ops.stga.dismiss(request="video")
        yield lambda video=video: not video.exists()
        seen[f"{name} written"] = (folder / f"{name}.mp4").exists()
    seen["frame after videos"] = scene.frame_current


def looks_at_head():
    """Whether every viewport shows the head, and little else."""
    head = chosen().head
    corners = [head.matrix_world @ Vector(corner) for corner in head.bound_box]
    center = sum(corners, Vector()) / len(corners)
    size = (corners[6] - corners[0]).length
    areas = [
        area
        for area in bpy.context.window_manager.windows[0].screen.areas
        if area.type == "VIEW_3D"
    ]
    views = [area.spaces.active.region_3d for area in areas]
    return all(
        (view.view_location - center).length < 0.1 * size
        and 0.2 * size < view.view_distance < 5 * size
        for view in views
    )


def splats_at_work():
    """Where the first splats are: training moves them."""
    mesh = chosen().splats.data
    return [value for vertex in mesh.vertices[:20] for value in vertex.co]


play({"first": first, "second": second}[PART](), Path(RESULT), PATIENCE_S)
