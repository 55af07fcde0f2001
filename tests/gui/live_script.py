"""Runs inside a Blender with a window, started by test_live.py: drives a head live, as a phone
would.

`blender --python live_script.py -- FOLDER PICTURES`: reads FOLDER/flame.npz, own.npz and
avatar.npz, writes FOLDER/result.json, screenshots, and with PICTURES above 0 as many pictures of
the viewport.
"""

import json
import socket
import struct
import subprocess
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import Any

import bpy
import numpy as np

FOLDER, PICTURES = Path(sys.argv[sys.argv.index("--") + 1]), int(sys.argv[sys.argv.index("--") + 2])
PORT, RATE, SECONDS, PICTURES_PER_SECOND = 21111, 60, 10.0, 10
seen: dict[str, Any] = {"version": bpy.app.version_string}
extension = next(name for name in bpy.context.preferences.addons.keys() if name.endswith(".stga"))  # noqa: SIM118
sessions = sys.modules[f"{extension}.operators.live_session"]
names = sys.modules[f"{extension}.stga_addon.driving.live.decoders"].PACKET_SHAPES
bpy.context.preferences.view.show_splash = False


def packet(number: int, t: float) -> bytes:
    """A face that speaks, smiles, blinks and turns, after t seconds."""
    wave = lambda hertz, phase=0.0: 0.5 - 0.5 * np.cos(2 * np.pi * (hertz * t + phase))  # noqa: E731
    values = {
        "jawOpen": 0.7 * wave(1.1) * wave(0.23),
        "mouthSmileLeft": wave(0.35),
        "mouthSmileRight": wave(0.35),
        "browInnerUp": wave(0.35, 0.3),
        "mouthPucker": 0.8 * wave(0.35, 0.5) * wave(0.7),
        "eyeBlinkLeft": float((t % 2.5) < 0.2),
        "eyeBlinkRight": float((t % 2.5) < 0.2),
    }
    head = (
        0.35 * np.sin(2 * np.pi * 0.2 * t),
        0.12 * np.sin(2 * np.pi * 0.31 * t),
        0.08 * np.sin(2 * np.pi * 0.17 * t),
    )
    row = [float(values.get(name, 0.0)) for name in names] + [*map(float, head)] + [0.0] * 6
    text = b"".join(struct.pack(">i", len(part)) + part for part in (b"DEVICE", b"phone"))
    return (
        b"\x06" + text + struct.pack(">ifii", number, 0.0, RATE, 1) + struct.pack(">B61f", 61, *row)
    )


def send() -> None:
    """A phone, until the session has ended."""
    sender, begin, number = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), time.monotonic(), 0
    while not seen.get("quit"):
        moment = seen.get("_moment", number / RATE)
        sender.sendto(packet(number, moment), ("127.0.0.1", PORT))
        number += 1
        time.sleep(max(0.0, begin + number / RATE - time.monotonic()))


def viewport() -> tuple[Any, Any, Any]:
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    return window, area, next(region for region in area.regions if region.type == "WINDOW")


def screenshot(name: str) -> None:
    subprocess.run(["import", "-window", "root", str(FOLDER / f"{name}.png")], check=True)


def set_up() -> None:
    window, area, region = viewport()
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.stga.import_motion(
            filepath=str(FOLDER / "own.npz"), flame=str(FOLDER / "flame.npz")
        )
        bpy.ops.stga.show_avatar(filepath=str(FOLDER / "avatar.npz"))
    space = area.spaces.active
    space.overlay.show_overlays = space.show_gizmo = space.show_region_toolbar = False
    space.show_region_ui = True
    settings = bpy.context.scene.stga.drive
    settings.port = PORT
    if PICTURES:
        only_drive_panel()


def only_drive_panel() -> None:
    """Leave the sidebar's tab with the Drive panel open, for pictures."""
    ui = sys.modules[f"{extension}.ui.panel"]
    kept = [
        sys.modules[f"{extension}.ui.motion_panel"].MotionPanel,
        sys.modules[f"{extension}.ui.motion_panel"].DrivePanel,
    ]
    for panel in reversed(ui.CLASSES):
        bpy.utils.unregister_class(panel)
    for panel in kept:
        panel.bl_options = set()
        bpy.utils.register_class(panel)


def count_draws() -> None:
    drawn: list[float] = []
    handle = bpy.types.SpaceView3D.draw_handler_add(
        lambda: drawn.append(time.monotonic()), (), "WINDOW", "POST_PIXEL"
    )
    seen["_drawn"], seen["_handle"] = drawn, handle


def steps() -> Any:
    set_up()
    yield 0.5
    sys.modules[f"{extension}.stga_addon.scene.avatar_scene"].open_sidebar("STGA", bpy.data.screens)
    yield 0.5
    threading.Thread(target=send, daemon=True).start()
    window, area, region = viewport()
    with bpy.context.temp_override(window=window, area=area, region=region):
        assert bpy.ops.stga.drive_live() == {"FINISHED"}
    running = sessions.session()
    yield 2.0
    posed = 0
    show = running._show

    def counted(*arguments: Any) -> None:
        nonlocal posed
        posed += 1
        show(*arguments)

    running._show = counted
    count_draws()
    begin = time.monotonic()
    if PICTURES:
        for number in range(PICTURES):
            seen["_moment"] = number / PICTURES_PER_SECOND
            yield 0.1
            bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
            screenshot(f"picture_{number:03d}")
    else:
        yield SECONDS
    took = time.monotonic() - begin
    seen["poses per second"], seen["draws per second"] = (
        posed / took,
        len(seen.pop("_drawn")) / took,
    )
    bpy.types.SpaceView3D.draw_handler_remove(seen.pop("_handle"), "WINDOW")
    health = running.stream.health(time.monotonic())
    seen["rate"], seen["lost"], seen["slowest tick ms"] = (
        health.rate,
        health.lost,
        1e3 * running.slowest_tick_s,
    )
    screenshot("driven")
    x, y = region.x + region.width // 2, window.height - region.y - region.height // 2
    subprocess.run(["xdotool", "mousemove", str(x), str(y)], check=True)
    yield 0.5
    subprocess.run(["xdotool", "key", "Escape"], check=True)
    yield 1.0
    seen["stopped by Esc"] = sessions.session() is None and running.receiver._socket.fileno() == -1


def finish() -> None:
    seen["quit"] = True
    (FOLDER / "result.json").write_text(
        json.dumps({name: value for name, value in seen.items() if name[0] != "_"})
    )
    bpy.ops.wm.quit_blender()


def play() -> float | None:
    try:
        return next(running_steps)  # type: ignore[no-any-return]
    except StopIteration:
        pass
    except Exception:
        seen["traceback"] = traceback.format_exc()
    finish()
    return None


running_steps = steps()
bpy.app.timers.register(play, first_interval=2.0, persistent=True)
