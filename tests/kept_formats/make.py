"""Small files of every format that is kept, as this version of the add-on writes them.

    PYTHONPATH=tests:. python -m kept_formats.make

writes `data/VERSION`. That of a version that was given out stays as it is.
"""

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from capture import factory

from stga_addon import __version__
from stga_addon.avatar.file import Avatar, AvatarLight, write_avatar
from stga_addon.avatar.offsets import OFFSETS
from stga_addon.avatar.splats import Splats
from stga_addon.export.playback import Playback
from stga_addon.export.rig import Rig, RiggedAvatar, ShapeControls
from stga_addon.export.skinned_gltf import skinned_glb
from stga_addon.flame.forward import frame_of
from stga_addon.flame.model import read_flame
from stga_addon.flame.sequence import FlameSequence
from stga_addon.jobs.perform import request_folder, write_request, write_result
from stga_addon.jobs.train import Train
from stga_addon.progress import Written
from stga_addon.training.effect_catalog import EffectDecision
from stga_addon.training.optimize.state import new_offset, new_state
from stga_addon.training.run.checkpoint import (
    Checkpoint,
    strain_range_of,
    write_checkpoint,
    write_selection,
)
from stga_addon.training.run.folder import (
    Continuation,
    Run,
    Take,
    write_residuals,
    write_run,
    write_tracking,
)
from stga_addon.training.run.identity import RunIdentity
from stga_addon.training.run.metrics_log import append_metrics
from stga_addon.training.settings import Rates, make_settings

DATA = Path(__file__).with_name("data")
SKINNED = "avatar.glb"
COUNT = 5
FACES = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]], np.int32)
NEUTRAL = np.array([[0, 0, 0], [0.25, 0, 0], [0, 0.25, 0], [0, 0, 0.25]], np.float32)
SELECTION = {0: np.array([True, False, True, False]), 12: np.ones(4, bool)}
RESIDUAL = np.array([0.25, np.nan, 0.5, 0.125], np.float32)
TIMESTEPS = (0, 3)
IDENTITY = RunIdentity("vhap", "1 cameras, 2 timesteps", *("abcdef"[k] * 64 for k in range(6)))
METRICS = {"iteration": 10, "seconds": 5.5, "evaluation_s": 0.5, "wall_s": 7.25, "splats": COUNT}
METRICS |= {"loss": 0.125, "psnr": 30.5, "ssim": 0.875, "peak_memory_mb": 512.0}
RATES = Rates(4e-4, 1e-2, 4e-2, 1e-1, 4e-2, 2e-3, 1e-2, position_end=0.025, end=0.3)


def ramp(*shape, start=0):
    """Float32 in −0.5…1 that every type in a file holds exactly."""
    values = (np.arange(np.prod(shape)) + start) % 97 / 64 - 0.5
    return values.reshape(shape).astype(np.float32)


def splats():
    return Splats(
        xyz=ramp(COUNT, 3),
        rotation=np.eye(4, dtype=np.float32)[[0, 1, 2, 3, 0]],
        log_scale=ramp(COUNT, 3, start=15) - 5,
        opacity=ramp(COUNT, start=30),
        sh=ramp(COUNT, 4, 3, start=35),
        face=np.array([0, 0, 1, 2, 3], np.int32),
        unbound=np.arange(COUNT) == 4,
    )


def avatar():
    light = AvatarLight(
        radiance=ramp(9, 3),
        transfer=ramp(4, 9) + 0.5,
        occlusion=np.array([0, 0.25, 0.5, 1], np.float32),
        irradiance=ramp(4, 3) + 1,
        roughness=np.array([0, 0, 0.25, 0.5], np.float32),
        residual=0.0625,
        damping=0.25,
        source="file",
    )
    low = np.full((4, 1, 6), -0.5, np.float32)
    return Avatar(
        splats(),
        "stga",
        NEUTRAL,
        FACES,
        settings={"iterations": 9},
        regions={"mouth": np.arange(4) < 1, "nose": np.arange(4) > 2},
        background=(1.0, 0.5, 0.0),
        antialiased=True,
        principal_point="opencv",
        strain_range=np.concatenate([low, -low], axis=1),
        driven_offsets={name: ramp(4, 3, 3, start=len(name)) / 8 for name in OFFSETS},
        light=light,
    )


def state():
    made = new_state(splats())
    for part in (made.first, made.second):
        for array in part:
            array[:] = ramp(*array.shape, start=len(array))
    made.steps += np.arange(1, COUNT + 1, dtype=np.int32)
    made.driven_offsets = {"strain_position": new_offset(ramp(4, 3, 3))}
    return made


def checkpoint():
    tracking = ramp(2, 23).astype(np.float64)
    digest = IDENTITY.digest
    return Checkpoint(
        state=state(),
        iteration=34,
        visit=7,
        last_timestep=12,
        initial_count=4,
        elapsed_s=12.5,
        evaluations=2,
        losses=(0.5, 0.25),
        lines=3,
        tracking_gain=0.125,
        tracking=tracking,
        rounds=1,
        identity=digest,
    )


def run():
    return Run(
        Path("/captures/anna"),
        Path("/models/flame.npz"),
        "opencv",
        make_settings(iterations=9, driven_offsets=("strain_position",), sh_degree=1, rates=RATES),
        (EffectDecision("jaw", "auto", True, "turns by 9°", "none"),),
        "gpu:Name",
        IDENTITY,
        (Take(Path("/captures/smile"), 100, IDENTITY),),
        Continuation(Path("/runs/anna"), "0" * 64, 100, 104),
    )


def train():
    settings = make_settings(iterations=3, preset="draft", rates=RATES)
    return Train(Path("/runs/anna"), Path("/captures/anna"), settings, selection=SELECTION)


def tracked_frames():
    """Those of a sequence before it was refined."""
    return {timestep: frame_of(ramp(20, start=timestep) / 8) for timestep in TIMESTEPS}


def refined():
    """(T, P + 3) parameters, and shifts of the torso."""
    return np.asarray(ramp(2, 23, start=40) / 8, np.float64)


def sequence(model_file):
    """With the frames of `tracked_frames`; writes the model."""
    model = read_flame(factory.write_flame_model(model_file))
    return FlameSequence(model, ramp(4), None, TIMESTEPS, tracked_frames().__getitem__)


def strain_range(folder):
    """Of a run of two timesteps in the folder: read, where there is none measured and written."""
    scales = 0.8 - ramp(2, 3) / 8
    views = {"train": [SimpleNamespace(timestep=timestep) for timestep in range(2)]}
    capture = SimpleNamespace(
        faces=FACES, neutral=NEUTRAL, views=views, mesh=lambda timestep: NEUTRAL * scales[timestep]
    )
    return strain_range_of(folder, capture, replace(run(), continuation=None))


def rigged():
    """On two joints, with two shapes of which one is a slider, in three frames."""
    controls = ShapeControls(("jawOpen", "mouthClose"), ramp(2, 10), ramp(2, 1), *("jawOpen",) * 2)
    rig = Rig(
        base=NEUTRAL,
        basis=ramp(2, 4, 3) / 16,
        correctives=ramp(9, 4, 3) / 64,
        joint_rest=np.array([[0, 0, 0], [0, 0.25, 0]]),
        joint_basis=ramp(2, 2, 3) / 16,
        joint_names=("root", "jaw"),
        parents=(-1, 0),
        weights=np.array([[1, 0], [0, 1], [1, 0], [0, 1]]),
        coefficients=ramp(3, 2),
        pose=ramp(3, 2, 3) / 2,
        translation=ramp(3, 3),
        expressions=1,
        expression_names=("smile",),
    )
    return RiggedAvatar(avatar(), rig, controls)


def make(folder):
    """Write the files of this version."""
    write_run(folder, run())
    write_avatar(folder / "avatar.npz", avatar())
    write_checkpoint(folder, checkpoint())
    write_selection(folder, SELECTION, IDENTITY.digest)
    strain_range(folder)
    write_residuals(folder, RESIDUAL)
    append_metrics(folder, METRICS)
    write_request(request_folder(folder), train())
    write_result(request_folder(folder), Written(Path("/runs/anna/avatar.npz"), ("PSNR 30 dB",)))
    (request_folder(folder) / "worker.log").unlink()
    playback = Playback("Anna", 30.0, selection=[np.arange(4) != k for k in range(3)])
    (folder / SKINNED).write_bytes(skinned_glb(rigged(), playback))
    with tempfile.TemporaryDirectory() as other:
        found = sequence(Path(other) / "model.npz")
        before = np.stack([found.frame(timestep).parameters for timestep in TIMESTEPS])
        write_tracking(folder, found, refined(), before)


if __name__ == "__main__":
    target = DATA / __version__
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    make(target)
