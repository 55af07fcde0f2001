"""What the scripts share that run inside a Blender with a window."""

import json
import subprocess
import sys
import time
import traceback
from contextlib import suppress

import bpy

ARGUMENTS = sys.argv[sys.argv.index("--") + 1 :]
STEP_S = 0.1
_addons = bpy.context.preferences.addons.keys()
extension = next((name for name in _addons if name.endswith(".stga")), "")
seen = {"version": bpy.app.version_string}
bpy.context.preferences.view.show_splash = False


def module(name):
    """A module of the extension."""
    return sys.modules[f"{extension}.{name}"]


def chosen():
    return bpy.context.scene.stga


def viewport(kind="WINDOW"):
    """The first window, its 3D viewport and a region of that."""
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    return window, area, next(region for region in area.regions if region.type == kind)


def in_viewport(kind="WINDOW"):
    """The context of a click there, which a timer has not."""
    window, area, region = viewport(kind)
    return bpy.context.temp_override(window=window, area=area, region=region)


def picture(file):
    bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=2)
    subprocess.run(["import", "-window", "root", str(file)], check=True)


def play(steps, result, patience_s=180.0):
    """Take steps, each when what the one before yielded has come true; write `seen`, and quit."""
    until = None
    since = time.monotonic()

    def step():
        nonlocal until, since
        waited = time.monotonic() - since
        try:
            if until() if callable(until) else waited >= (until or 0):
                until = next(steps)
                since = time.monotonic()
            elif waited > patience_s:
                raise TimeoutError(f"waited in vain after {list(seen)}")
            return STEP_S
        except StopIteration:
            pass
        except Exception:
            seen["traceback"] = traceback.format_exc()
            with suppress(RuntimeError):
                picture(result.with_name("failed.png"))
        result.write_text(json.dumps(seen, indent=1))
        bpy.ops.wm.quit_blender()
        return None

    bpy.app.timers.register(step, first_interval=2.0, persistent=True)
