"""Runs inside a real Blender with the complete edition, started by test_real_blender.py: a
newcomer's first training.

`blender --background --python complete_script.py -- RESULT WAIT BUDGET`, where BUDGET is an
argument of Train, as `iterations=60`, and RESULT the JSON file that says what was seen. WAIT: 0 to
leave while the worker trains.
"""

import json
import os
import sys
from pathlib import Path

import bpy

RESULT, WAIT, BUDGET = sys.argv[sys.argv.index("--") + 1 :]
module = next(name for name in bpy.context.preferences.addons.keys() if name.endswith(".stga"))  # noqa: SIM118
this_python = sys.modules[f"{module}.stga_addon.worker.training_python"].this_python
seen = {"version": bpy.app.version_string, "python": sys.version.split()[0]}


def write():
    Path(RESULT).write_text(json.dumps(seen, indent=1))


def leave(worker):
    seen["worker"] = worker
    write()
    os._exit(0)


bpy.ops.stga.open_demo()
settings = bpy.context.scene.stga
run = Path(settings.run_folder)
seen["run"] = str(run)
name, value = BUDGET.split("=")
budget = {name: float(value) if name == "minutes" else int(value)}
if WAIT == "0":
    # What a window does, which returns while the worker starts.
    start = sys.modules[f"{module}.operators.request"].start_worker
    sys.modules[f"{module}.operators.request"].start_worker = lambda *given: leave(
        start(*given).pid
    )
bpy.ops.stga.train(directory=str(run), python=this_python(), **budget)
bpy.ops.stga.show_avatar(filepath=settings.avatar)
seen["splats"] = len(settings.splats.data.vertices)
write()
