"""A newcomer's first hour with the complete edition, in a window without a network: see
test_scenario.py.

STGA_GUI_FOLDER: where the pictures of the steps are left.
"""

import json
import os
import shlex
from pathlib import Path

import pytest
from blender.test_real_blender import blender, complete_zip, install

from stga_addon.development.demo.capture import unpack_capture

BLENDER = shlex.split(os.environ.get("STGA_BLENDER", ""))
pytestmark = pytest.mark.skipif(
    not BLENDER, reason="STGA_BLENDER does not say how to start a Blender with a window"
)
SCRIPT = Path(__file__).with_name("newcomer_script.py")


def test_the_first_hour(tmp_path: Path) -> None:
    """Catches a step of the first hour that needs more than its click, and what only a window
    has."""
    unpack_capture(tmp_path / "demo")
    archive, home = complete_zip(BLENDER, tmp_path / "dist", tmp_path / "demo"), tmp_path / "home"
    home.mkdir()
    pictures = Path(os.environ.get("STGA_GUI_FOLDER", tmp_path))
    pictures.mkdir(exist_ok=True)
    install(BLENDER, home, archive)
    blender(BLENDER, home, "--python", SCRIPT, "--", pictures, background=False)
    seen = json.loads((pictures / "result.json").read_text())
    print(seen)
    assert "traceback" not in seen, seen["traceback"]
    assert seen["video"] == "finished"
    assert len(seen["error"]) <= 90
    assert seen["error in the panel"].endswith("which has not been saved yet")
    assert seen["shading of points"] == "MATERIAL"
    assert abs(seen["exposure"]) > 0.1
    assert len(set(seen["frame of row"])) == 1
    assert (seen["run found"], seen["undone"], seen["appended"]) == (True, 1, True)
    assert len(seen["pressed"]) > 10
    assert seen["left"]
    assert max(map(len, seen["messages"].values())) <= 90, seen["messages"]
    assert seen["proposed file"] == ""
    for name in ("turntable.mp4", "avatar.html"):
        assert (pictures / name).stat().st_size > 0
