"""A FLAME capture drawn from true parameters, whose tracked parameters are off."""

from dataclasses import replace

import numpy as np
from capture import factory
from PIL import Image

from stga_addon.avatar.embedding import face_frames
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.capture.open import open_capture
from stga_addon.render.render import render, to_uint8
from stga_addon.training.optimize.avatar_tracking import AvatarTracking

TIMESTEPS = (0, 2, 3, 5, 6)
CAMERAS = range(5)
"""The last timestep is `test`, the last camera `val`."""
PLACES = (0, 1, 3, 4, 2)
"""Of the cameras, side by side: `val` is in the middle."""
LENS_SIDE_PX = 96
LENS = {"w": LENS_SIDE_PX, "h": LENS_SIDE_PX, "cx": 48.0, "cy": 48.0, "fl_x": 380.0, "fl_y": 380.0}
NOISE = {"expr": 0.5, "rotation": 0.02, "jaw_pose": 0.04, "translation": 0.002}
"""What a tracker is off by where the error is 1: coefficients of some 2 mm, radians, meters."""


def write_head(root, error=1.0):
    """The ball in FLAME's format, and timestep -> mesh (V, 3) that its images show."""
    _, model = factory.write_flame_capture(root, TIMESTEPS, CAMERAS)
    factory.write_splits(
        root, [_entry(timestep, camera) for timestep in TIMESTEPS for camera in CAMERAS]
    )
    for path in (root / "fg_masks").iterdir():  # of the lens's size, as a capture opens with
        Image.new("L", (LENS_SIDE_PX, LENS_SIDE_PX)).save(path)
    true = open_capture(root, model)
    _paint(true)
    meshes = {timestep: true.mesh(timestep) for timestep in TIMESTEPS}
    _lose_track(root, error)
    return open_capture(root, model), meshes


def parameters_of(capture, timesteps):
    """(T, P) as tracked."""
    return np.stack([capture.flame.frame(timestep).parameters for timestep in timesteps])


def tracked_as(timesteps, parameters, **more):
    """What an avatar has tracked: parameters (T, P), and of all else nothing."""
    count = len(parameters)
    typical = {"misfit": np.zeros(count), "shift": np.zeros((count, 3)), "scale": np.ones(count)}
    values = {**typical, "information": np.eye(1), **more}
    return AvatarTracking(tuple(timesteps), parameters, **values)


def _entry(timestep, camera):
    pose = factory.pose(PLACES[camera]).tolist()
    return factory.frame(
        timestep,
        camera,
        flame_param_path=f"flame_param/{timestep:05d}.npz",
        transform_matrix=pose,
        **LENS,
    )


def _lose_track(root, error):
    """Disturb what was tracked, but for the test timestep.

    Of an error that all timesteps share nobody could tell whether it is the tracker's or the
    splats', so there is none.
    """
    rng = np.random.default_rng(0)
    trained = TIMESTEPS[:-1]
    shapes = {name: factory.flame_parameters(0)[name].shape for name in NOISE}
    away = {
        name: rng.normal(0, error * size, (len(trained), *shapes[name]))
        for name, size in NOISE.items()
    }
    for row, timestep in enumerate(trained):
        tracked = factory.flame_parameters(timestep)
        for name, steps in away.items():
            tracked[name] = tracked[name] + (steps - steps.mean(0))[row]
        np.savez(root / f"flame_param/{timestep:05d}.npz", **tracked)


def _paint(capture):
    """Draw every view of the capture as it is tracked, over white, and its mask."""
    rng = np.random.default_rng(1)
    splats = lattice_splats(capture.neutral, capture.faces, order=3, sh_degree=0, opacity_logit=4.0)
    place = capture.neutral[capture.faces[splats.face]].mean(1) / factory.RADIUS
    color = 1.2 * np.sin(place @ rng.normal(0, 4, (3, 3)) + rng.uniform(0, 6, 3))
    shown = replace(splats, sh=color[:, None].astype(np.float32))
    blank = replace(splats, sh=np.full_like(shown.sh, 9.0))
    for view in (view for views in capture.views.values() for view in views):
        frames = face_frames(capture.mesh(view.timestep), capture.faces, capture.neutral)
        Image.fromarray(to_uint8(render(shown, view.camera, (1.0, 1.0, 1.0), frames))).save(
            view.image
        )
        alpha = to_uint8(render(blank, view.camera, (0.0, 0.0, 0.0), frames))[..., 0]
        Image.fromarray(np.where(alpha > 127, 255, 0).astype(np.uint8)).save(view.mask)
