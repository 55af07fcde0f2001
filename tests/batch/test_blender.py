"""Frames of an animation on workers, by a real Blender (STGA_BLENDER, docs/blender.md)."""

import os
import shlex
import sys

import numpy as np
import pytest
from blender.zips import output_of
from capture.factory import write_avatar_of, write_mesh_capture
from PIL import Image

from stga_addon.capture.open import open_capture
from stga_addon.development.package import ROOT, build_zip
from stga_addon.jobs.batch.engines import LocalEngine
from stga_addon.jobs.batch.plan import read_plan
from stga_addon.jobs.batch.run import JobState

from .simulated import carry_out

BLENDER = shlex.split(os.environ.get("STGA_BLENDER", ""))
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not BLENDER, reason="STGA_BLENDER does not say how to start a Blender"),
]
MAKE = """
import bpy
folder = {folder!r}
bpy.ops.wm.read_homefile(use_empty=True)
bpy.ops.stga.import_capture(directory=folder + "/capture", principal_point="opencv")
bpy.ops.stga.show_avatar(filepath=folder + "/avatar.npz")
render = bpy.context.scene.render
render.resolution_x = render.resolution_y = 96
render.resolution_percentage, render.engine = 100, "BLENDER_WORKBENCH"
render.filepath = "//wrong/"
bpy.ops.wm.save_as_mainfile(filepath=folder + "/head.blend")
"""
PLAN = """
out = "{engine}"
[resources]
threads = 1
memory_gb = 1
""" + "".join(
    f'[job.film-{first}]\nrequest = "render-blend"\nblend = "head.blend"\nframes = [{first}, '
    f"{last}]\n"
    for first, last in ((0, 1), (2, 3), (4, 4))
)


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    """A folder with an animated head in a .blend file, and its frames 0 to 4 in `whole`."""
    folder = tmp_path_factory.mktemp("shot")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BLENDER_USER_RESOURCES", str(folder / "profile"))
        patch.setenv("STGA_PYTHON", sys.executable)
        archive = build_zip(folder)
        blender(f"--command extension install-file --repo user_default --enable {archive}")
        capture = open_capture(write_mesh_capture(folder / "capture", (0, 1, 3, 4), range(4)))
        write_avatar_of(capture, folder / "avatar.npz")
        (folder / "make.py").write_text(MAKE.format(folder=str(folder)))
        blender(f"--background --python-exit-code 1 --python {folder}/make.py")
        blender(
            f"--background {folder}/head.blend --engine STGA_SPLATS --render-output "
            f"{folder}/whole/###### --render-format PNG --frame-start 0 --frame-end 4 --render-anim"
        )
        yield folder


def blender(words):
    output_of([*BLENDER, *words.split()], timeout=600, cwd=ROOT)


def pictures(folder):
    return {path.name: np.asarray(Image.open(path)) for path in sorted(folder.rglob("*.png"))}


def check(shot, engine):
    whole = pictures(shot / "whole")
    found = pictures(shot / engine)
    assert list(found) == list(whole) == [f"{frame:06d}.png" for frame in range(5)]
    for name, picture in whole.items():
        np.testing.assert_array_equal(found[name], picture)
    assert any((whole["000000.png"] != picture).any() for picture in whole.values())  # it moves
    assert sorted(path.name for path in (shot / engine).glob("film-*")) == [
        f"film-{first}" for first in (0, 2, 4)
    ]


def plan_of(shot, engine):
    path = shot / f"{engine}.toml"
    path.write_text(PLAN.format(engine=engine))
    return path


def test_frames_through_the_local_engine(shot):
    """Catches frames that a worker's Blender renders by another engine, leaves out, or repeats."""
    plan = read_plan(plan_of(shot, "local"))
    batch, _ = carry_out(plan, LocalEngine(2, 8.0))
    assert {entry.state for entry in batch.entries.values()} == {JobState.FINISHED}, batch.failures
    check(shot, "local")
    batch, _ = carry_out(plan, LocalEngine(2, 8.0))
    assert {entry.state for entry in batch.entries.values()} == {JobState.KEPT}
