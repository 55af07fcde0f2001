"""Commands that are refused: one sentence, exit code 2, and nothing written."""

import json
import re
import shutil

import numpy as np
import pytest
import trimesh
from capture import factory
from command_line import refused, stga

from stga_addon.training.run.folder import read_run

REFUSALS = """
# Options that have no effect, or none there
$ export {run} --format gltf --frames 0:1 --out {o}
--frames: has no effect with --format gltf, only with ply-sequence, usd, web
$ export {run} --format usd --timestep 1 --out {o}
--timestep: has no effect with --format usd, only with ply, gltf
$ export {run} --format ply --motion-only --out {o}
--motion-only: has no effect with --format ply, only with web
$ export {run} --format usd --out {o}.usda
o.usda: expected a name that ends in .usdc or .usdz
$ export {avatar} --format web --out {o}.txt
.html
$ render {run} --video {o}.avi
ends in .mp4
$ render {run} --video {o}.mp4 --camera 7
there are only 0, 1, 2
$ render {run} --video {o}.mp4 --fps 0
frame rate (--fps) must be from 0.01
$ render {run} --out {o}
needs --cameras
$ render {run} --out {o} --camera 1
--camera: has no effect without --video or --turntable
$ render {run} --out {o} --turntable --seconds 1e9
--seconds 1e+09: is 25000000000 images at 25 frames per second; expected up to 100000
$ render {run} --out {o} --cameras {cameras} --frames 7:9
--frames 7:9: there is no such timestep
$ render {run} --out {o} --turntable 90 --frames 1:3
--frames: has no effect with --turntable
$ refine {run}
--region: is missing
$ extend {run}
CAPTURE: is missing
# Options that another replaces, or that have no effect without another
$ train {root} --out {o} --iterations 1 --schedule paper --strategy gaussian-avatars
--schedule paper: cannot be combined with --strategy gaussian-avatars, which has settings of its own
$ train {root} --out {o} --iterations 1 --schedule paper --preset draft
--preset: cannot be combined with --schedule paper
$ train {root} --out {o} --iterations 1 --preset final --strategy gaussian-avatars
--preset: cannot be combined with --strategy gaussian-avatars
$ train {root} --out {o} --iterations 1 --threshold 0.01
--threshold: has no effect without --strategy selective, or --schedule paper
$ train {root} --out {o} --iterations 1 --threshold 0.01 --strategy global --schedule paper
--threshold: has no effect without
$ avatar {root} --model m.npz --out {o} --threshold 0.01
--threshold: has no effect without --strategy
$ render {avatar} --video v.mp4 --capture {root} --principal-point opencv
--principal-point: has no effect without --cameras
$ export {avatar} --format ply --out {o}.ply --motion take.csv
--motion: has no effect with --format ply without --timestep
$ track {root} --out {o} --take around --cameras {cameras}
--take around: does not go with --cameras
$ track {root} --out {o} --take talk --cameras {cameras}
--take talk: does not go with --cameras
$ select {root} --zero-pose all
--zero-pose: has no effect on {root}, whose meshes have no pose
$ track {root} --out {o} --take around
--take around: {root} has a calibration already
$ info {root} --flame {model}
--flame: has no effect on {root}, which is read without a model
# A resumed run goes on as it began
$ train {root} --out {run} --resume --stop-when-flat
--stop-when-flat: this run began with
$ train {root} --out {run} --resume --preset final
--preset: this run began with
$ refine {none} --region mouth --resume
--region: has no effect with --resume
$ refine {none} --frames 1-3 --resume
--frames: has no effect with --resume
$ refine {none} --budget 1m --resume
--budget: has no effect with --resume
$ refine {none} --out anna_2 --resume
--out: has no effect with --resume
$ extend {none} --seed 1 --resume
--seed: has no effect with --resume
$ extend {none} smile --resume
CAPTURE: has no effect with --resume
$ refine {run} --resume
does not continue another run
# Captures that are missing, broken, or others
$ train {none} --out {o} --iterations 3
is not a folder
$ train {broken} --out {o} --iterations 3
transforms_val.json: is not valid JSON
$ info {broken}
transforms_val.json: is not valid JSON
$ select {broken}
transforms_val.json: is not valid JSON
$ train {bare} --out {o} --iterations 3
has no training views
$ render {avatar} --capture {coarse} --cameras {cameras} --out {o}
{coarse}: its mesh has other triangles
$ export {run} --capture {coarse} --format ply-sequence --out {o}
{coarse}: its mesh has other triangles
$ export {run} --format gaussian-avatars --out {o}
needs the FLAME parameters of a FLAME capture
$ render {avatar} --cameras {cameras} --motion {folder}/motion.npz --out {o}
give the FLAME model file
$ render {avatar} --cameras {cameras} --motion {root} --flame {model} --out {o}
was not tracked with FLAME
$ render {folder}/mesh.ply --cameras {cameras} --motion {folder}/motion.npz --out {o}
mesh.ply, which holds splats in the world
$ benchmark {blind} --out {o}
has no views to measure with
$ benchmark {root} --out {o} --only fast
--only: 'fast' is not one of draft, standard
$ benchmark {root} --out {o} --only draft --knobs
--only: 'draft' is not one of standard, scale-0.5
$ batch {root} --preset draft
--out: is missing
$ batch {root} --out {o}
--preset: is missing
$ batch {folder}/plan.toml --seed 2
--seed: has no effect with a plan
# Runs and avatars that are missing, broken, or there already
$ train {root} --out {run} --iterations 3
already holds a run; resume it
$ refine {run} --region mouth --out {run}
already holds a run
$ train {root} --out {none} --resume
holds no run
$ train {root} --out {file} --iterations 3
cannot be written
$ eval {avatar}
avatar.npz
$ eval {root}
holds no run
$ render {folder}/half.npz --capture {root} --cameras {cameras} --out {o}
half.npz: 
$ render {folder}/foreign.npz --capture {root} --cameras {cameras} --out {o}
foreign.npz: 
$ render {folder}/none.npz --capture {root} --cameras {cameras} --out {o}
none.npz: 
$ render {folder}/mesh.ply --cameras {cameras} --out {o}
mesh.ply: 
$ render {folder}/none.ply --cameras {cameras} --out {o}
none.ply: 
# What a capture has not, or is to keep
$ render {avatar} --cameras {cameras} --out {o}
give --capture
$ export {avatar} --format ply-sequence --out {o}
give --capture
$ export {avatar} --format ply --timestep 1 --out {o}.ply
give --capture
$ export {avatar} --format web --frames 1:2 --out {o}.html
give --capture
$ export {run} --format ply-sequence --frames 7:9 --out {o}
has no timestep from 7 to 9
$ export {run} --format ply --timestep 2 --out {o}.ply
has no timestep 2
$ render {run} --cameras {later} --out {o}
has no mesh for timestep 2
$ refine {run} --region chin
neither a region of the capture
$ render {run} --cameras {cameras} --out {root}/meshes/../images --device cpu
is an image of the capture; choose another --out
"""
"""Command, and part of the sentence that refuses it, with the names of `refusable`."""
ROWS = re.findall(r"^\$ (.*)\n(.*)$", REFUSALS, re.MULTILINE)


@pytest.fixture(scope="session")
def refusable(root, trained, tmp_path_factory):
    """What REFUSALS name, by name."""
    folder = tmp_path_factory.mktemp("refusals")
    own = "broken", "bare", "blind", "coarse", "file", "none", "o", "run"
    names = {name: folder / name for name in own} | {"root": folder / "ball", "folder": folder}
    shutil.copytree(trained, names["run"])
    shutil.copytree(root, names["root"])
    inside = {"avatar": "run/avatar.npz", "later": "ball/a.json"}
    inside["cameras"] = "ball/transforms_val.json"
    names |= {name: folder / path for name, path in inside.items()}
    for name in ("broken", "bare", "blind", "coarse"):
        shutil.copytree(root, names[name])

    (names["blind"] / "transforms_val.json").unlink()
    (names["broken"] / "transforms_val.json").write_text('{"frames": [')
    for split in ("train", "test"):
        (names["bare"] / f"transforms_{split}.json").unlink()
    at = str(names["root"])
    factory.edit(names["run"] / "run.json", lambda document: document.update(capture=at))
    sphere = trimesh.creation.icosphere(1, factory.RADIUS)
    for path in (names["coarse"] / "meshes").iterdir():
        factory.write_mesh(path, np.array(sphere.vertices), np.array(sphere.faces))
    (names["coarse"] / "regions.json").write_text(json.dumps({"mouth": [0, 1, 2]}))
    shutil.copy(names["cameras"], names["later"])
    factory.edit(names["later"], lambda document: document["frames"][0].update(timestep_index=2))
    whole = names["avatar"].read_bytes()
    (folder / "half.npz").write_bytes(whole[: len(whole) // 2])
    np.savez(folder / "foreign.npz", a=np.zeros(3))
    np.savez(folder / "motion.npz", expr=np.zeros((2, 2)), pose=np.zeros((2, 15)))
    (folder / "plan.toml").touch()
    names["model"] = factory.write_flame_model(folder / "model.npz")
    (folder / "mesh.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n"
    )
    names["file"].write_text("x")
    return names


@pytest.mark.parametrize(("command", "says"), ROWS, ids=[command for command, _ in ROWS])
def test_refusals(refusable, capsys, command, says):
    """Catches a traceback, talk of something else, and files that a refused command leaves."""

    def files():
        found = refusable["folder"].rglob("*")
        return {path: path.read_bytes() for path in found if path.is_file()}

    before = files()
    assert says.format(**refusable) in refused(capsys, *command.format(**refusable).split())
    assert files() == before
    assert not refusable["o"].exists()
    assert not refusable["none"].exists()


def test_a_threshold_is_given_again_when_a_run_is_resumed(root, tmp_path):
    """Catches `train --resume` that refuses the threshold that the run began with."""
    run = f"train {root} --out {tmp_path}/run --device cpu"
    chosen = "--threshold 0.01 --schedule paper --iterations 1"
    assert stga(run, chosen) == 0
    assert stga(run, chosen, "--resume") == 0
    assert stga(run, "--threshold 0.01 --resume") == 0
    assert stga(run, "--threshold 0.02 --resume") == 2
    assert read_run(tmp_path / "run").settings.selection.threshold == 0.01
