"""Playback in a 3D viewport: splats as trained against the same splats as points.

    blender --python benchmarks/playback.py [-- --splats 65536 --rounds 5]

Runs in a Blender with a window, in which the extension is enabled: a head of 9,976 triangles moves by a shape key. Each
round plays the same frames in every display, so that other work on the machine slows all of them; times are medians in
milliseconds for a frame and its redraw. The file that is open is not saved.
"""

import argparse
import statistics
import sys
import traceback
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
FRAMES = range(1, 9)
SHADINGS = "SOLID", "MATERIAL"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=65_536)
    parser.add_argument("--rounds", type=int, default=5)
    return parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])


def moving_head(splats: int) -> Any:
    """The splats of an avatar on a head that a keyframed shape key moves."""
    sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]  # the extension has put the packages of both on the path
    avatar = import_module("redraw").head_avatar(splats, has_strain=True)
    mesh = import_module("stga_addon.scene.arrays").triangle_mesh("head", avatar.neutral, avatar.faces)
    head = bpy.data.objects.new("head", mesh)
    bpy.context.scene.collection.objects.link(head)
    head.shape_key_add(name="Basis")
    key = head.shape_key_add(name="moved")
    moved = avatar.neutral * np.array([1.1, 0.95, 1.1], np.float32)
    key.data.foreach_set("co", np.ascontiguousarray(moved, np.float32).ravel())
    for frame, value in ((FRAMES[0], 0.0), (FRAMES[-1], 1.0)):
        key.value = value
        key.keyframe_insert("value", frame=frame)
    shown = import_module("stga_addon.scene.display.splat_object").show_avatar(avatar, head)
    head.hide_set(True)
    return shown


def frame_times() -> list[float]:
    """Milliseconds of each frame with its redraw; the first, which compiles and uploads, is drawn before."""
    bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
    times = []
    for frame in FRAMES:
        begin = perf_counter()
        bpy.context.scene.frame_set(frame)
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
        times.append(1e3 * (perf_counter() - begin))
    return times


def measure(splats: int, rounds: int) -> Iterator[None]:
    for candidate in list(bpy.data.objects):
        bpy.data.objects.remove(candidate)
    shown = moving_head(splats)
    area = next(area for area in bpy.context.window_manager.windows[0].screen.areas if area.type == "VIEW_3D")
    space = area.spaces.active
    space.region_3d.view_location, space.region_3d.view_distance = (0.0, 0.0, 0.0), 0.5
    set_input = import_module("stga_addon.scene.display.splat_object").set_input
    display = import_module("stga_addon.scene.display.splat_nodes").DISPLAY
    modes = import_module("stga_addon.scene.display.display_modes")
    cases = [(mode, shading) for shading in SHADINGS for mode in (modes.AS_TRAINED, modes.POINTS)]
    times: dict[tuple[str, str], list[float]] = {case: [] for case in cases}
    for _ in range(rounds):
        for mode, shading in cases:
            set_input(shown, display, mode)
            space.shading.type = shading
            yield
            times[mode, shading] += frame_times()
    for shading in SHADINGS:
        trained, points = (statistics.median(times[mode, shading]) for mode in (modes.AS_TRAINED, modes.POINTS))
        print(
            f"{splats} splats, {shading}: as trained {trained:.0f} ms, points {points:.0f} ms, "
            f"ratio {trained / points:.2f}",
            flush=True,
        )


def main() -> None:
    chosen = arguments()
    running = measure(chosen.splats, chosen.rounds)

    def step() -> float | None:
        try:
            next(running)
            return 0.5
        except StopIteration:
            pass
        except Exception:
            traceback.print_exc()
        bpy.ops.wm.quit_blender()
        return None

    bpy.context.preferences.view.show_splash = False
    bpy.app.timers.register(step, first_interval=1.0)


main()
