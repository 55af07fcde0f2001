"""Runs inside a Blender with a window and the complete edition, started by test_newcomer.py: the
first ten minutes.

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
LOOK_S = 10.0
"""For which a newcomer looks at the head before Train is clicked."""
NECK_ANGLE, VIDEO_S = 0.3, 2.0
STARTED = time.monotonic()
seen: dict[str, Any] = {"version": bpy.app.version_string}
extension = next(name for name in bpy.context.preferences.addons.keys() if name.endswith(".stga"))  # noqa: SIM118
monitor = sys.modules[f"{extension}.operators.monitor"]
open_sidebar = sys.modules[f"{extension}.stga_addon.scene.avatar_scene"].open_sidebar
bpy.context.preferences.view.show_splash = False


def chosen() -> Any:
    return bpy.context.scene.stga


def viewport() -> Any:
    """What an operator called from the sidebar of the viewport has as its context."""
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    region = next(region for region in area.regions if region.type == "WINDOW")
    return bpy.context.temp_override(window=window, area=area, region=region)


def picture(name: str) -> None:
    bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=2)
    subprocess.run(["import", "-window", "root", str(FOLDER / f"{name}.png")], check=False)


def sidebar() -> bool:
    return bool(
        open_sidebar("STGA", [window.screen for window in bpy.context.window_manager.windows])
    )


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
    yield sidebar
    picture("demo")


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


def steps() -> Iterator[Callable[[], bool]]:
    clock = Clock()
    for step in (install, open_demo, train, pose, turntable, page):
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
