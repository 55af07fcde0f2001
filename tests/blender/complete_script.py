"""Runs inside a real Blender with the complete edition, started by test_real_blender.py: a
newcomer's first training.

`blender --background --python complete_script.py -- RESULT WAIT BUDGET`, where BUDGET is an
argument of Train, as `iterations=60`, and RESULT the JSON file that says what was seen. WAIT: 0 to
leave while the worker trains.
"""

import json
import os
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import bpy

RESULT, WAIT, BUDGET = sys.argv[sys.argv.index("--") + 1 :]
module = next(name for name in bpy.context.preferences.addons.keys() if name.endswith(".stga"))  # noqa: SIM118
own_python = sys.modules[f"{module}.stga_addon.worker.training_python"].own_python
seen: dict[str, object] = {"version": bpy.app.version_string, "python": sys.version.split()[0]}


def watch(job: Path, clicked: float) -> None:
    """Note when each stage of the training began, and when its first preview was there."""
    stages: dict[str, float] = {}
    seen["stages"] = stages
    while not (job / "preview.npz").exists():
        with suppress(OSError, ValueError):  # not written yet
            stages.setdefault(
                json.loads((job / "status.json").read_text())["message"], time.monotonic() - clicked
            )
        time.sleep(0.05)
    seen["preview_s"] = time.monotonic() - clicked


def timed(name: str, action: object, **options: object) -> None:
    begin = time.monotonic()
    action(**options)  # type: ignore[operator]
    seen[name] = time.monotonic() - begin


def write() -> None:
    Path(RESULT).write_text(json.dumps(seen, indent=1))


def leave(worker: int) -> None:
    seen["worker"] = worker
    write()
    os._exit(0)


timed("open_demo_s", bpy.ops.stga.open_demo)
settings = bpy.context.scene.stga
run = Path(settings.run_folder)
seen["run"] = str(run)
threading.Thread(target=watch, args=(run / "job", time.monotonic()), daemon=True).start()
name, value = BUDGET.split("=")
budget = {name: float(value) if name == "minutes" else int(value)}
if WAIT == "0":
    # What a window does, which returns while the worker starts.
    start = sys.modules[f"{module}.operators.request"].start_worker
    sys.modules[f"{module}.operators.request"].start_worker = lambda *given: leave(
        start(*given).pid
    )
timed("train_s", bpy.ops.stga.train, directory=str(run), python=own_python(), **budget)
timed("show_s", bpy.ops.stga.show_avatar, filepath=settings.avatar)
seen["splats"] = len(settings.splats.data.vertices)
write()
