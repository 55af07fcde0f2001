"""The Train step in a Blender with a window."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from capture.factory import write_mesh_capture

from stga_addon.development.package import build_zip
from stga_addon.worker.status import request_cancel

from .conftest import BLENDER

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with an empty Blender profile in which the built zip is installed."""
    folder = tmp_path_factory.mktemp("gui")
    archive = build_zip(folder)
    command = ("--command", "extension", "install-file", "--repo", "user_default", "--enable")
    blender(folder, *command, archive)
    yield folder
    for job in folder.glob("*/job"):  # whatever failed: no worker stays behind
        request_cancel(job)


def blender(home, *arguments):
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(home / "profile")}
    command = [*BLENDER, *map(str, arguments)]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=3600
    )
    (home / "output.txt").open("a").write(done.stdout + done.stderr)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


def play(home, part, capture, *file):
    """What a part of scenario.py saw."""
    result = home / f"{part}.json"
    script = Path(__file__).with_name("scenario.py")
    arguments = (part, result, capture, home / "head.blend", sys.executable)
    blender(home, *file, "--python", script, "--", *arguments)
    seen = json.loads(result.read_text())
    assert "traceback" not in seen, seen["traceback"]
    return seen


def test_training_in_a_window(home):
    """Catches what only a window has: timers, undo, workers that outlive Blender."""
    capture = Path(os.environ.get("STGA_GUI_CAPTURE") or write_mesh_capture(home / "capture"))
    seen = play(home, "first", capture)
    assert seen["tested"].startswith(f"Python {sys.version.split()[0]}, torch ")
    assert {"iteration", "per_second", "left_s", "splats", "memory_mb"} <= set(seen["figures"])
    assert seen["refreshed"]
    assert seen["cancelled"]["avatar"]
    assert seen["cancelled"]["splats"] > 0
    assert seen["resumed at"] > 0
    assert "signal 9" in seen["lost"]
    assert seen["lost"] in seen["clipboard"]
    assert "worker.log" in seen["clipboard"]
    assert seen["undone"] == ""
    assert seen["reopened"]
    os.kill(seen["left"], 0)  # Blender has quit, the worker goes on

    then = play(home, "second", capture, home / "head.blend")
    assert then["found"] == seen["left"]
    assert then["more"] > 1
    assert then["finished"]["avatar"] == str(home / "run_2/avatar.npz")
    assert then["finished"]["splats"] > 0
    assert then["dismissed"]
    written = [then[f"{name} written"] for name in ("recording", "rendering", "finished")]
    assert written == [False, False, True]
    assert (then["video rendering"], then["video finished"]) == ("cancelled", "finished")
    assert then["frame after videos"] == 1
