"""Runs inside a Blender with a window and the complete edition, started by test_newcomer.py: the
first hour.

`blender --python newcomer_script.py -- FOLDER`: writes FOLDER/result.json with times, and a picture
of each step.
"""

import json
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import bpy
from mathutils import Quaternion, Vector

FOLDER = Path(sys.argv[sys.argv.index("--") + 1])
STEP_S, PATIENCE_S = 0.2, 600.0
WORKERS = (
    "train", "refine", "extend", "analyze_capture", "estimate_light", "render_video", "drive_live",
    "drive_video", "avatar_from_video", "track_footage", "solve_again", "select_extension",
)  # fmt: skip
"""Operators that start what goes on after them."""
LOOK_S = 10.0
"""For which a newcomer looks at the head before Train is clicked."""
NECK_ANGLE, MOUTH, VIDEO_S = 0.3, 0.6, 2.0
STARTED = time.monotonic()
seen: dict[str, Any] = {"version": bpy.app.version_string}
extension = next(name for name in bpy.context.preferences.addons.keys() if name.endswith(".stga"))  # noqa: SIM118
monitor = sys.modules[f"{extension}.operators.monitor"]
bpy.context.preferences.view.show_splash = False


def chosen() -> Any:
    return bpy.context.scene.stga


def viewport() -> Any:
    """What an operator called from the sidebar of the viewport has as its context."""
    window = bpy.context.window_manager.windows[0]
    region = next(region for region in area().regions if region.type == "WINDOW")
    return bpy.context.temp_override(window=window, area=area(), region=region)


def area() -> Any:
    screen = bpy.context.window_manager.windows[0].screen
    return next(area for area in screen.areas if area.type == "VIEW_3D")


def picture(name: str) -> None:
    bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=2)
    subprocess.run(["import", "-window", "root", str(FOLDER / f"{name}.png")], check=False)


def sidebar() -> Any:
    return next(region for region in area().regions if region.type == "UI")


def write() -> None:
    (FOLDER / "result.json").write_text(json.dumps(seen, indent=1))


class Clock:
    """Seconds from its making, noted under a name."""

    def __init__(self) -> None:
        self.begin = time.monotonic()

    def note(self, name: str) -> None:
        seen[name] = round(time.monotonic() - self.begin, 2)
        write()


def install() -> Iterator[Callable[[], bool]]:
    bpy.context.preferences.extensions.use_online_access_handled = True
    bpy.ops.screen.userpref_show(section="EXTENSIONS")
    yield lambda: True
    preferences = bpy.context.window_manager.windows[-1]
    bpy.context.window_manager.extension_search = "STGA"
    yield lambda: True
    picture("install")
    with bpy.context.temp_override(window=preferences):
        bpy.ops.wm.window_close()


def open_demo() -> Iterator[Callable[[], bool]]:
    clock = Clock()
    with viewport():
        bpy.ops.stga.open_demo()
    clock.note("open_demo_s")
    yield lambda: sidebar().active_panel_category == "STGA"
    picture("demo")


def misunderstand() -> Iterator[Callable[[], bool]]:
    """Train into a folder that a file never saved does not have."""
    with viewport():
        try:
            bpy.ops.stga.train(directory="//run")
        except RuntimeError as error:
            seen["error"] = str(error).strip().removeprefix("Error: ")
    seen["error in the panel"] = bpy.context.window_manager.stga_message
    yield lambda: True
    picture("error")


def train() -> Iterator[Callable[[], bool]]:
    clock = Clock()
    yield lambda: time.monotonic() > clock.begin + LOOK_S
    seen["clicked_after_start_s"] = round(time.monotonic() - STARTED, 2)
    clock = Clock()
    with viewport():
        bpy.ops.stga.train(directory=chosen().run_folder, minutes=chosen().minutes)
    job = Path(chosen().run_folder) / "job"
    yield lambda: (job / "preview.npz").exists()
    clock.note("preview_written_s")
    yield lambda: chosen().splats is not None
    clock.note("preview_s")
    picture("preview")
    yield lambda: chosen().result_shown
    clock.note("trained_s")
    picture("trained")


def pose() -> Iterator[Callable[[], bool]]:
    with viewport():
        bpy.ops.stga.pose_head()
    yield lambda: True
    neck = bpy.context.view_layer.objects.active.pose.bones["neck"]
    side = neck.bone.matrix_local.to_3x3().inverted() @ Vector((1.0, 0.0, 0.0))
    neck.rotation_quaternion = Quaternion(side, NECK_ANGLE)
    chosen().head.data.shape_keys.key_blocks["jawOpen"].value = MOUTH
    yield lambda: True
    picture("posed")
    with viewport():
        bpy.ops.stga.pose_head()


def turntable() -> Iterator[Callable[[], bool]]:
    clock = Clock()
    with viewport():
        bpy.ops.stga.render_video(filepath=str(FOLDER / "turntable.mp4"), seconds=VIDEO_S)
    video = monitor.Kind("video")
    yield lambda: not monitor.state_of(bpy.context.scene, video).is_running
    clock.note("video_s")
    seen["video"] = str(monitor.state_of(bpy.context.scene, video).snapshot.state)
    picture("turntable")


def page() -> Iterator[Callable[[], bool]]:
    clock = Clock()
    with viewport():
        bpy.ops.stga.export_avatar(
            "EXEC_DEFAULT", filepath=str(FOLDER / "avatar.html"), format="web"
        )
    yield (FOLDER / "avatar.html").exists
    clock.note("page_s")


def display() -> Iterator[Callable[[], bool]]:
    shading, lighting = area().spaces.active.shading, bpy.context.scene.stga_lighting
    shading.type = "SOLID"
    with viewport():
        bpy.ops.stga.choose_display(display="Points")
    seen["shading of points"] = shading.type
    yield lambda: True
    picture("points")
    with viewport():
        bpy.ops.stga.choose_display(display="As Trained")
    shading.type = "SOLID"
    clock = Clock()
    lighting.mode = "scene"
    clock.note("scene_light_s")
    seen["exposure"] = lighting.exposure
    yield lambda: True
    picture("lit")
    lighting.mode = "recorded"


def select() -> Iterator[Callable[[], bool]]:
    with viewport():
        bpy.ops.stga.select()
    chosen().selected_row = 2
    seen["frame of row"] = [bpy.context.scene.frame_current, chosen().selected_frames[2].frame]
    yield lambda: True
    picture("selected")


def press() -> Iterator[Callable[[], bool]]:
    """Call every operator that can be called here as its button does, and undo it."""
    bpy.ops.wm.open_mainfile(filepath=str(FOLDER / "first.blend"))
    seen["pressed"], seen["messages"] = [], {}
    for name in sorted({*dir(bpy.ops.stga)} - {*WORKERS}):
        operator = getattr(bpy.ops.stga, name)
        with viewport():
            bpy.ops.ed.undo_push(message="before")
            if not operator.poll():
                continue
            try:
                operator("EXEC_DEFAULT", True)
                seen["pressed"].append(name)
            except RuntimeError as error:
                seen["messages"][name] = str(error).strip().removeprefix("Error: ")
            bpy.ops.ed.undo_push(message="after")
            bpy.ops.ed.undo()
        yield lambda: True
    seen["left"] = chosen().splats is not None
    picture("pressed")


def reopen() -> Iterator[Callable[[], bool]]:
    """Save, open again, duplicate the splats, undo, and append them to another file."""
    run, file = Path(chosen().run_folder), FOLDER / "first.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(file))
    bpy.ops.wm.open_mainfile(filepath=str(file))
    yield lambda: True
    seen["run found"] = Path(bpy.path.abspath(chosen().run_folder)) == run
    shown = chosen().splats
    with viewport():
        for thing in bpy.context.selected_objects:
            thing.select_set(False)
        bpy.context.view_layer.objects.active = shown
        shown.select_set(True)
        bpy.ops.ed.undo_push(message="before")
        bpy.ops.object.duplicate()
    yield lambda: True
    count = len(bpy.data.objects)
    with viewport():
        bpy.ops.ed.undo()
    seen["undone"] = count - len(bpy.data.objects)
    yield lambda: True
    picture("reopened")
    name = chosen().splats.name
    bpy.ops.wm.read_homefile(app_template="")
    yield lambda: True
    with viewport():
        bpy.ops.wm.append(directory=f"{file}/Object/", filename=name)
    seen["appended"] = name in bpy.data.objects
    yield lambda: True
    picture("appended")


def choose_file() -> Iterator[Callable[[], bool]]:
    """Open the file browser of Import Capture from a saved file."""
    bpy.ops.wm.open_mainfile(filepath=str(FOLDER / "first.blend"))
    yield lambda: True
    with viewport():
        bpy.ops.stga.import_capture("INVOKE_DEFAULT")
    yield lambda: True
    browser = bpy.context.window_manager.windows[-1].screen.areas[0].spaces.active
    seen["proposed file"] = browser.params.filename
    picture("browser")


def steps() -> Iterator[Callable[[], bool]]:
    clock = Clock()
    for step in (
        install, open_demo, misunderstand, train, pose, turntable, page, display, select,
        reopen, press, choose_file,
    ):  # fmt: skip
        yield from step()
    clock.note("all_s")


class Player:
    """Takes the steps, one after another as their conditions come true."""

    def __init__(self) -> None:
        self.steps, self.until, self.since = steps(), (lambda: True), time.monotonic()

    def __call__(self) -> float | None:
        try:
            if self.until():
                self.until, self.since = next(self.steps), time.monotonic()
            elif time.monotonic() - self.since > PATIENCE_S:
                raise TimeoutError(f"waited in vain after {list(seen)}")
            return STEP_S
        except StopIteration:
            pass
        except Exception:
            seen["traceback"] = traceback.format_exc()
            picture("failed")
        write()
        bpy.ops.wm.quit_blender()
        return None


bpy.app.timers.register(Player(), first_interval=3.0, persistent=True)
